"""Style and script of the report, and the colors of its two schemes."""

from __future__ import annotations

LIGHT = {
    "ground": "#ffffff",
    "panel": "#f4f6f8",
    "ink": "#1b1f24",
    "soft": "#4d5761",
    "edge": "#d3d9df",
    "link": "#0b5cad",
    "c0": "#a36c00",
    "c1": "#2781b5",
    "c2": "#00825f",
    "c3": "#807800",
    "c4": "#0060a0",
    "c5": "#b84e00",
    "c6": "#ad5285",
}
"""Colors on white; ``c0`` to ``c6`` are those of `draw_tracks`, darker where they would not be seen."""

DARK = {
    "ground": "#101418",
    "panel": "#191f25",
    "ink": "#e6eaee",
    "soft": "#a7b1bb",
    "edge": "#36404a",
    "link": "#7cb8f2",
    "c0": "#e69f00",
    "c1": "#56b4e9",
    "c2": "#009e73",
    "c3": "#f0e442",
    "c4": "#1f84c6",
    "c5": "#e8701a",
    "c6": "#cc79a7",
}
"""Colors on black."""


def _variables(colors: dict[str, str]) -> str:
    return "".join(f"--{name}:{value};" for name, value in colors.items())


STYLE = (
    f":root{{color-scheme:light dark;{_variables(LIGHT)}}}\n"
    f"@media(prefers-color-scheme:dark){{:root{{{_variables(DARK)}}}}}\n"
    + "".join(f".c{number}{{--c:var(--c{number})}}\n" for number in range(7))
    + """\
*{box-sizing:border-box}
body{margin:0 auto;max-width:88rem;padding:1rem;background:var(--ground);color:var(--ink);
 font:1rem/1.5 system-ui,-apple-system,"Segoe UI",Roboto,"Noto Sans",sans-serif}
h1{font-size:1.6rem;line-height:1.25;margin:.25rem 0}
h2{font-size:1.25rem;line-height:1.5;margin:2rem 0 .5rem}
h3{font-size:1rem;margin:0}
h1,h2,h3,p,dd,td{overflow-wrap:anywhere}
p{margin:.25rem 0 .75rem}
.soft,figcaption p,footer{color:var(--soft)}
a{color:var(--link)}
:focus-visible{outline:3px solid var(--link);outline-offset:2px}
.facts{display:grid;grid-template-columns:repeat(auto-fit,minmax(8.5rem,1fr));gap:.5rem;margin:1rem 0}
.facts div{background:var(--panel);border:1px solid var(--edge);border-radius:.5rem;padding:.5rem .75rem}
dt{color:var(--soft);font-size:.875rem}
dd{margin:0}
.facts dd{font-size:1.125rem;font-weight:600;font-variant-numeric:tabular-nums}
.lines{display:grid;grid-template-columns:repeat(auto-fill,minmax(min(24rem,100%),1fr));gap:.125rem 2rem;
 margin:.5rem 0}
.lines div{display:grid;grid-template-columns:10rem minmax(0,1fr);gap:1rem;align-items:baseline}
.film{background:var(--ground);padding-bottom:.25rem}
video{display:block;width:100%;max-height:75vh;background:#000;border-radius:.5rem}
.told{margin:.25rem 0;min-height:3em;font-variant-numeric:tabular-nums}
.told b{margin-right:.5rem}
.told span{white-space:nowrap;margin-right:.75rem}
.told span::before{content:"";display:inline-block;width:.7em;height:.7em;border-radius:50%;
 margin-right:.3em;background:var(--c)}
figure{margin:0 0 1rem}
figcaption p{font-size:.875rem;margin:0 0 .25rem}
.graph{display:grid;grid-template-columns:44px minmax(0,1fr);padding:8px 0 0}
svg{display:block}
.values,.plot{overflow:visible}
.plot{cursor:crosshair;touch-action:pan-y}
svg text{font-size:12px;fill:var(--soft);font-variant-numeric:tabular-nums}
svg .name{pointer-events:none;fill:var(--ink);font-weight:600;
 stroke:var(--ground);stroke-width:3px;paint-order:stroke}
.grid{stroke:var(--edge)}
.zero{stroke:var(--soft)}
.line{fill:none;stroke:var(--c);stroke-width:2px;stroke-linejoin:round;vector-effect:non-scaling-stroke}
.band{fill:var(--c);opacity:.2}
.count{fill:var(--link)}
.plot .count{opacity:.75}
.bar{cursor:pointer}
.bar rect{fill:var(--c);stroke:var(--c)}
.bar:focus-visible{outline:none}
.bar:focus-visible rect{stroke:var(--ink);stroke-width:3px}
.faded{opacity:.15}
.mark,.now{visibility:hidden;pointer-events:none}
.mark{stroke:var(--soft);stroke-dasharray:3 3}
.now{stroke:var(--ink);stroke-width:2px}
.mark.on,.now.on{visibility:visible}
.scroll{overflow:auto;max-height:32rem;width:fit-content;max-width:100%}
table{border-collapse:collapse;font-variant-numeric:tabular-nums}
th,td{text-align:right;padding:.25rem .75rem;border-bottom:1px solid var(--edge);white-space:nowrap}
th:first-child{text-align:left;padding-left:.125rem}
thead th{position:sticky;top:0;background:var(--ground);color:var(--soft);font-weight:500;font-size:.875rem}
tbody th{font-weight:600}
.dot{display:inline-block;width:.75em;height:.75em;border-radius:50%;background:var(--c);margin-right:.4em}
.share{display:inline-block;width:5rem;margin-left:.5rem}
button{font:inherit;font-variant-numeric:tabular-nums;color:var(--link);background:none;border:0;
 padding:.125rem .25rem;text-decoration:underline;cursor:pointer}
details{border:1px solid var(--edge);border-radius:.5rem;margin:.5rem 0;padding:.5rem .75rem}
summary{cursor:pointer;font-weight:600}
footer{margin:2rem 0 1rem;font-size:.875rem}
@media(min-width:68rem){
 .stage{display:grid;grid-template-columns:minmax(0,11fr) minmax(0,9fr);gap:0 1.5rem;align-items:start}
 .film{position:sticky;top:-2rem}
}
@media(max-width:67.99rem){
 .film{position:sticky;top:-2.375rem;z-index:1}
 video{max-height:40vh}
}
@media(max-width:30rem){
 body{padding:.75rem}
 th,td{padding:.25rem .375rem}
 tbody th{white-space:normal;min-width:4.5rem}
 .share{width:3rem}
 .facts{grid-template-columns:1fr 1fr}
 .lines div{grid-template-columns:8rem minmax(0,1fr);gap:.5rem}
}
@media(prefers-reduced-motion:no-preference){.curve,.bar{transition:opacity .15s}}
@media print{.film,.scroll{position:static;max-height:none}}
"""
)

SCRIPT = """\
"use strict";
const data = JSON.parse(document.getElementById("data").textContent);
const video = document.querySelector("video");
const told = document.querySelector(".told");

// Some browsers play a file from the memory, but no data: address.
const source = video && video.querySelector('source[src^="data:"]');
if (source) {
  const address = source.getAttribute("src"), comma = address.indexOf(",");
  const text = atob(address.slice(comma + 1)), bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
  source.remove();
  video.src = URL.createObjectURL(new Blob([bytes], {type: source.type}));
}

const clock = seconds => {
  const tenths = Math.round(seconds * 10), minutes = Math.floor(tenths / 600);
  const end = ((tenths % 600) / 10).toFixed(1).padStart(4, "0");
  if (minutes < 60) return minutes + ":" + end;
  return Math.floor(minutes / 60) + ":" + String(minutes % 60).padStart(2, "0") + ":" + end;
};

// Put the line of one kind, in all charts, on a frame.
function mark(kind, frame) {
  const x = (frame + .5) / data.frames * 100 + "%";
  for (const line of document.querySelectorAll("." + kind)) {
    line.setAttribute("x1", x);
    line.setAttribute("x2", x);
    line.classList.add("on");
  }
}

// Write the time of a frame and what is known of its vehicles.
function tell(frame) {
  const there = data.tracks.filter(track => track.spans.some(([from, to]) => from <= frame && frame < to));
  const time = document.createElement("b");
  time.textContent = clock(frame / data.fps) + (there.length ? "" : " no vehicle");
  told.replaceChildren(time, ...there.map(track => {
    const point = Math.floor(frame / data.step) - track.first, name = document.createElement("span");
    const meters = track.distance[point], speed = track.speed[point];
    name.className = "c" + track.color;
    name.textContent = "#" + track.id;
    if (meters != null) name.textContent += " " + meters.toFixed(0) + " m";
    if (speed != null) {
      const sign = speed > 0 ? "+" : speed < 0 ? "\u2212" : "";
      name.textContent += " " + sign + Math.abs(speed).toFixed(1) + " m/s";
    }
    return name;
  }));
}

const inside = frame => Math.min(Math.max(frame, 0), data.frames - 1);
let now = 0, over = false;
function tick() {
  if (video) now = inside(Math.floor(video.currentTime * data.fps + .01));
  mark("now", now);
  if (!over) tell(now);
  if (video && !video.paused && !video.ended) requestAnimationFrame(tick);
}
function seek(frame) {
  if (video) video.currentTime = (inside(frame) + .5) / data.fps;
}
if (video) for (const name of ["play", "timeupdate", "seeking", "seeked"]) video.addEventListener(name, tick);
tick();

for (const plot of document.querySelectorAll(".plot")) {
  const frameAt = event => {
    const box = plot.getBoundingClientRect();
    return inside(Math.floor((event.clientX - box.left) / box.width * data.frames));
  };
  plot.addEventListener("pointermove", event => {
    over = true;
    mark("mark", frameAt(event));
    tell(frameAt(event));
    if (event.buttons) seek(frameAt(event));
  });
  plot.addEventListener("pointerleave", () => {
    over = false;
    for (const line of document.querySelectorAll(".mark")) line.classList.remove("on");
    tell(now);
  });
  plot.addEventListener("click", event => {
    if (!event.target.closest("[data-frame]")) seek(frameAt(event));
  });
}

// While a bar is pointed at, the other tracks step back.
function fade(id) {
  for (const part of document.querySelectorAll("[data-track]"))
    part.classList.toggle("faded", id !== null && part.dataset.track !== id);
}
for (const part of document.querySelectorAll("[data-frame]")) {
  part.addEventListener("click", () => seek(Number(part.dataset.frame)));
  if (!part.dataset.track) continue;  // a button of the table: its keys work by themselves
  part.addEventListener("keydown", event => {
    if (event.key !== "Enter" && event.key !== " ") return;
    event.preventDefault();
    seek(Number(part.dataset.frame));
  });
  for (const name of ["pointerenter", "focus"]) part.addEventListener(name, () => fade(part.dataset.track));
  for (const name of ["pointerleave", "blur"]) part.addEventListener(name, () => fade(null));
}
"""
