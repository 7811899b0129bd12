"use strict";
const data = JSON.parse(document.getElementById("data").textContent);
const video = document.querySelector("video");
const readout = document.querySelector(".readout");

// Some browsers play a blob: URL, but no data: URL.
const source = video && video.querySelector('source[src^="data:"]');
if (source) {
  const url = source.getAttribute("src"), comma = url.indexOf(",");
  const text = atob(url.slice(comma + 1)), bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
  source.remove();
  video.src = URL.createObjectURL(new Blob([bytes], {type: source.type}));
}

// As format_time in Python, with tenths.
function formatTime(seconds) {
  const tenths = Math.round(seconds * 10), minutes = Math.floor(tenths / 600);
  const end = ((tenths % 600) / 10).toFixed(1).padStart(4, "0");
  if (minutes < 60) return minutes + ":" + end;
  return Math.floor(minutes / 60) + ":" + String(minutes % 60).padStart(2, "0") + ":" + end;
}

function clampFrame(frame) {
  return Math.min(Math.max(frame, 0), data.frames - 1);
}

// Move the line of a class, "cursor" or "playhead", to a frame in all charts.
function moveLine(name, frame) {
  const x = (frame + .5) / data.frames * 100 + "%";
  for (const line of document.querySelectorAll("." + name)) {
    line.setAttribute("x1", x);
    line.setAttribute("x2", x);
    line.classList.add("visible");
  }
}

// Show the time of a frame and the distances and speeds of its vehicles.
function showReadout(frame) {
  const visible = data.tracks.filter(track => track.spans.some(([from, to]) => from <= frame && frame < to));
  const time = document.createElement("b");
  const own = data.own[Math.floor(frame / data.step)];
  time.textContent = formatTime(frame / data.fps) + (own == null ? "" : " own speed " + Math.round(own) + " " + data.units[1]);
  if (!visible.length) time.textContent += " no vehicle";
  readout.replaceChildren(time, ...visible.map(track => {
    const index = Math.floor(frame / data.step) - track.first, name = document.createElement("span");
    const distance = track.distance[index], speed = track.speed[index];
    name.className = "c" + track.color;
    name.textContent = "#" + track.id;
    if (distance != null) name.textContent += (track.rough[index] ? " ~" : " ") + distance.toFixed(0) + " " + data.units[0];
    if (speed != null) {
      const rounded = Math.round(speed), sign = rounded > 0 ? "+" : rounded < 0 ? "\u2212" : "";
      name.textContent += " " + sign + Math.abs(rounded) + " " + data.units[1] + (own == null ? "" : " relative");
    }
    return name;
  }));
}

// Charts of values: round ticks, lines of the tracks with bands of standard errors, labels at their ends.
function draw(plot, parent, name, attributes, text = "") {
  const made = document.createElementNS(plot.namespaceURI, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  made.textContent = text;
  parent.insertBefore(made, parent.querySelector(":scope > .cursor"));
  return made;
}
function roundTicks(low, high, maxSteps, minStep) {
  const extent = Math.max(high - low, 1e-6), power = 10 ** Math.floor(Math.log10(extent / maxSteps));
  const step = Math.max([1, 2, 5, 10].map(n => n * power).find(n => n * maxSteps >= extent * .999), minStep);
  const first = Math.floor(low / step + 1e-9), last = Math.max(Math.ceil(high / step - 1e-9), first + 1);
  return Array.from({length: last - first + 1}, (_, n) => (first + n) * step);
}
// Start and end of each run of known values.
function knownRuns(values) {
  const starts = values.flatMap((value, n) => value != null && values[n - 1] == null ? [n] : []);
  return starts.map(start => {
    let stop = start;
    while (values[stop] != null) stop++;
    return [start, stop];
  });
}
// Move labels up or down until none overlap; those that would be far from their lines are left out.
function placeLabels(labels, height) {
  const placed = [], size = 13;
  for (const label of labels.sort((one, other) => one.y - other.y || one.x - other.x)) {
    const start = Math.min(Math.max(label.y, size), height - 2);
    const near = placed.filter(other => Math.abs(other.x - label.x) < 5).map(other => other.y);
    const free = [start, ...near.flatMap(y => [y + size, y - size])].filter(y => Math.abs(y - start) <= 1.5 * size
      && y >= size - 2 && y <= height - 2 && near.every(taken => Math.abs(y - taken) >= size - 1e-6));
    free.sort((one, other) => Math.abs(one - start) - Math.abs(other - start));
    if (free.length) placed.push({...label, y: free[0]});
  }
  return placed;
}
function drawChart(plot) {
  const {series} = plot.dataset, height = Number(plot.dataset.height), bars = series === "count" ? data.counts : null;
  const lines = bars ? [] : data.tracks.map(track => ({...track, values: track[series], stds: series === "distance" ? track.std : null}));
  if (series === "ground") lines.push({values: data.own, first: 0, stds: null});
  let [low, high] = [0, 0];
  for (const value of bars ? bars.heights : lines.flatMap(({values, stds}) => values.map((each, n) => each + (each && stds && stds[n]))))
    [low, high] = [Math.min(low, value), Math.max(high, value)];
  const ticks = roundTicks(low, high, bars ? 3 : 4, bars ? 1 : 0), bottom = ticks[0], top = ticks[ticks.length - 1];
  const y = value => ((top - value) / (top - bottom) * height).toFixed(2);
  const x = frame => (Math.min(frame / data.frames, 1) * 1000).toFixed(2);
  for (const tick of ticks) {
    const text = String(+tick.toPrecision(6)).replace("-", "\u2212"), axis = plot.closest(".graph").querySelector(".values");
    draw(plot, axis, "text", {x: "100%", dx: -6, y: +y(tick) + 4, "text-anchor": "end"}, text);
    draw(plot, plot, "line", {class: tick === 0 && low < 0 ? "zero" : "grid", x1: 0, x2: "100%", y1: y(tick), y2: y(tick)});
  }
  const inner = draw(plot, plot, "svg", {viewBox: "0 0 1000 " + height, preserveAspectRatio: "none", width: "100%", height});
  if (bars) draw(plot, inner, "path", {class: "count", d: bars.heights.map((value, n) =>
    value ? `M${x(bars.edges[n])},${y(0)}V${y(value)}H${x(bars.edges[n + 1])}V${y(0)}Z` : "").join("")});
  const labels = [];
  for (const {id, color, first, values, stds} of lines) {
    const runs = knownRuns(values), last = runs.length ? runs[runs.length - 1][1] - 1 : 0;
    if (!runs.length) continue;
    const middle = n => (first + n + .5) * data.step;
    const points = ([start, stop], sign) => values.slice(start, stop).map((value, n) =>
      x(middle(start + n)) + "," + y(value + (sign && sign * stds[start + n])));
    // A single point gets a short line, as a line without length is invisible.
    const path = runs.map(run => "M" + points(run, 0).join(" ")
      + (run[1] - run[0] > 1 ? "" : "h" + Math.max(data.step / data.frames * 1000, 2))).join("");
    const group = draw(plot, inner, "g", id ? {class: "curve c" + color, "data-track": id} : {class: "curve own"});
    if (stds) draw(plot, group, "path", {class: "band", d: runs.map(run => "M" + [...points(run, 1), ...points(run, -1).reverse()].join(" ") + "Z").join("")});
    draw(plot, group, "path", {class: "line", d: path});
    if (id && (last - runs[0][0]) * data.step >= data.min_labeled * data.frames)
      labels.push({x: Math.min(middle(last) / data.frames, 1) * 100, y: y(values[last]) - 4, id, color});
  }
  for (const {x, y, id, color} of placeLabels(labels, height))
    draw(plot, plot, "text", {class: "track-name c" + color, x: x + "%", y, ...(x < 90 ? {dx: 4} : {dx: -4, "text-anchor": "end"})}, "#" + id);
}
document.querySelectorAll(".plot[data-series]").forEach(drawChart);

// Zoomed charts are wider than their column and scroll together.
const zoomBar = document.querySelector(".zoom"), scrolls = [...document.querySelectorAll(".scroll")];
const length = data.frames / data.fps, maxZoom = 2 ** Math.floor(Math.log2(Math.max(length / 10, 1)));
let zoom = 1;
const allTimes = [...document.querySelectorAll(".times")].map(group => [group, group.innerHTML]);
function drawTimes() {
  const steps = [1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600];
  const step = steps.find(each => length / zoom / each < 6) || 3600;
  for (const [group, markup] of allTimes) {
    group.innerHTML = markup;
    if (zoom === 1) continue;
    const [line, text] = [group.querySelector("line"), group.querySelector("text")];
    group.replaceChildren();
    for (let time = 0; time <= length; time += step) {
      const copies = [line.cloneNode(), text.cloneNode()], x = time / length * 100 + "%";
      for (const name of ["x1", "x2"]) copies[0].setAttribute(name, x);
      copies[1].setAttribute("x", x);
      copies[1].setAttribute("text-anchor", time ? "middle" : "start");
      copies[1].textContent = formatTime(time).slice(0, -2);
      group.append(...copies);
    }
  }
}
function scrollCharts(frame) {
  for (const each of scrolls) each.scrollLeft = (frame + .5) / data.frames * each.scrollWidth - each.clientWidth / 2;
}
function setZoom(value) {
  const hidden = scrolls[0].scrollWidth > scrolls[0].clientWidth, center = zoom > 1 && hidden
    ? (scrolls[0].scrollLeft + scrolls[0].clientWidth / 2) / scrolls[0].scrollWidth * data.frames : current;
  zoom = Math.min(Math.max(value, 1), maxZoom);
  document.body.classList.toggle("zoomed", zoom > 1);
  for (const each of scrolls) each.firstChild.style.width = zoom * 100 + "%";
  zoomBar.querySelector("output").textContent = zoom > 1 ? formatTime(length / zoom).slice(0, -2) + " of " + formatTime(length).slice(0, -2) : "whole video";
  for (const button of zoomBar.querySelectorAll("button"))
    button.disabled = Number(button.dataset.factor) > 1 ? zoom >= maxZoom : zoom <= 1;
  drawTimes();
  scrollCharts(center);
}
for (const each of scrolls) each.addEventListener("scroll", () => {
  for (const other of scrolls) if (Math.abs(other.scrollLeft - each.scrollLeft) >= 1) other.scrollLeft = each.scrollLeft;
});

let current = 0, hovering = false;
function updatePlayhead() {
  if (video) current = clampFrame(Math.floor(video.currentTime * data.fps + .01));
  moveLine("playhead", current);
  if (zoom > 1 && video && !video.paused) scrollCharts(current);
  if (!hovering) showReadout(current);
  if (video && !video.paused && !video.ended) requestAnimationFrame(updatePlayhead);
}
function seek(frame) {
  if (video) video.currentTime = (clampFrame(frame) + .5) / data.fps;
}
if (video) {
  for (const name of ["play", "timeupdate", "seeking", "seeked"]) video.addEventListener(name, updatePlayhead);
}
updatePlayhead();

for (const plot of document.querySelectorAll(".plot")) {
  const frameAt = event => {
    const box = plot.getBoundingClientRect();
    return clampFrame(Math.floor((event.clientX - box.left) / box.width * data.frames));
  };
  plot.addEventListener("pointermove", event => {
    hovering = true;
    moveLine("cursor", frameAt(event));
    showReadout(frameAt(event));
    if (event.buttons) seek(frameAt(event));
  });
  plot.addEventListener("pointerleave", () => {
    hovering = false;
    for (const line of document.querySelectorAll(".cursor")) line.classList.remove("visible");
    showReadout(current);
  });
  plot.addEventListener("click", event => {
    if (!event.target.closest("[data-frame]")) seek(frameAt(event));
  });
}

if (zoomBar && maxZoom > 1) {
  zoomBar.hidden = false;
  for (const button of zoomBar.querySelectorAll("button"))
    button.addEventListener("click", () => setZoom(zoom * Number(button.dataset.factor)));
  setZoom(1);
}

// Fade all tracks but one; null fades none.
function highlightTrack(id) {
  for (const element of document.querySelectorAll("[data-track]"))
    element.classList.toggle("faded", id !== null && element.dataset.track !== id);
}
for (const element of document.querySelectorAll("[data-frame]")) {
  const seekTo = () => seek(Number(element.dataset.frame));
  element.addEventListener("click", seekTo);
  if (!element.dataset.track) continue;  // a <button>, which handles keys itself
  element.addEventListener("keydown", event => {
    if (event.key !== "Enter" && event.key !== " ") return;
    event.preventDefault();
    seekTo();
  });
  for (const name of ["pointerenter", "focus"])
    element.addEventListener(name, () => highlightTrack(element.dataset.track));
  for (const name of ["pointerleave", "blur"]) element.addEventListener(name, () => highlightTrack(null));
}
