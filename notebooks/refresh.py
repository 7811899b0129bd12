"""Run the notebooks again and save them with their results.

``python notebooks/refresh.py`` runs all, ``python notebooks/refresh.py 4 7`` two of them. They run
on what the project draws itself, whatever `VEHICLE_DETECTION_DATA` says, each in a kernel of its
own and in this folder. What would change from one run to the next is not kept: times of execution,
and widgets, of which a page shows nothing without a kernel. Measured times do change: cells with
the tag ``timing`` keep their results while everything else in the notebook stays the same, unless
``--timings`` is given.

The first picture of a cell with the tag ``gallery`` goes to ``docs/gallery`` as well.
"""

from __future__ import annotations

import argparse
import base64
import os
import time
from pathlib import Path
from typing import Any

import cv2
import nbformat
import numpy as np
from nbclient import NotebookClient

HERE = Path(__file__).resolve().parent
GALLERY = HERE.parent / "docs" / "gallery"

LIMIT = 150
"""Seconds that a notebook may take."""

MOST_BYTES = 1_500_000
"""Size that a notebook may have."""

_PNG, _JPEG = "image/png", "image/jpeg"
_QUALITY = 86
_GALLERY_WIDTH = 640
_METADATA = {
    "kernelspec": {"display_name": "Python 3 (ipykernel)", "language": "python", "name": "python3"},
    "language_info": {"name": "python"},
}


def notebooks() -> list[Path]:
    """List the notebooks in the order of their numbers."""
    return sorted(HERE.glob("[0-9]*.ipynb"))


def read(path: Path) -> Any:
    """Read a notebook."""
    return nbformat.read(path, as_version=4)  # type: ignore[no-untyped-call]


def run(path: Path, *, data: str | None = None, limit: float = LIMIT) -> Any:
    """Run a notebook to its end, on the real data of a folder or on what the project draws.

    Raises
    ------
    nbclient.exceptions.CellExecutionError
        If a cell fails, an assert among them.
    RuntimeError
        If a cell writes to standard error, such as a warning.
    TimeoutError
        If it takes longer than `limit` seconds.
    """
    # A backend or data folder of the caller's is not the reader's.
    left_out = ("VEHICLE_DETECTION_DATA", "MPLBACKEND")
    environment = {name: value for name, value in os.environ.items() if name not in left_out}
    if data is not None:
        environment["VEHICLE_DETECTION_DATA"] = data
    notebook = read(path)
    deadline = time.monotonic() + limit
    client = NotebookClient(
        notebook,
        timeout_func=lambda cell: max(1.0, deadline - time.monotonic()),
        kernel_name="python3",
        resources={"metadata": {"path": str(HERE)}},
        extra_arguments=["--log-level=ERROR"],
        record_timing=False,
        store_widget_state=False,
    )
    client.execute(env=environment)
    for cell in _code(notebook):
        for output in cell.outputs:
            if output.output_type == "stream" and output.name == "stderr":
                raise RuntimeError(
                    f"{path.name}, cell {cell.id!r} writes to standard error: {output.text}"
                )
    return notebook


def _code(notebook: Any) -> list[Any]:
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def tags(cell: Any) -> list[str]:
    """List a cell's tags."""
    return list(cell.metadata.get("tags", []))


def tidy(notebook: Any, committed: Any, *, timings: bool = False) -> None:
    """Drop from a notebook that has run what the next run would change without reason."""
    notebook.metadata = nbformat.from_dict(_METADATA)
    for cell in _code(notebook):
        cell.metadata = nbformat.from_dict({"tags": tags(cell)} if tags(cell) else {})
        cell.outputs = [output for output in cell.outputs if not _is_widget(output)]
        for output in cell.outputs:
            if _PNG in output.get("data", {}):
                _shrink(output.data)
    if timings or _steady(notebook) != _steady(committed):
        return
    for cell, old in zip(_code(notebook), _code(committed)):
        if "timing" in tags(cell) and old.outputs:
            cell.outputs = old.outputs


def _steady(notebook: Any) -> list[Any]:
    """List all sources, and all results but measured times."""
    return [
        (cell.source, None if "timing" in tags(cell) else cell.outputs) for cell in _code(notebook)
    ]


def _is_widget(output: Any) -> bool:
    return any("widget" in kind for kind in output.get("data", {}))


def _shrink(data: Any) -> None:
    """Keep a photograph as JPEG; charts stay as they are."""
    png = base64.b64decode(data[_PNG])
    jpeg = _encode(_decode(png), ".jpg")
    if len(jpeg) < 0.5 * len(png):
        del data[_PNG]
        data[_JPEG] = base64.b64encode(jpeg).decode("ascii")


def _decode(data: bytes) -> Any:
    return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)


def _encode(image: Any, suffix: str) -> bytes:
    return bytes(cv2.imencode(suffix, image, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1])


def save_gallery(notebook: Any, name: str) -> None:
    """Write the first picture of the cell with the tag ``gallery``."""
    for cell in _code(notebook):
        if "gallery" not in tags(cell):
            continue
        for output in cell.outputs:
            held = output.get("data", {}).get(_JPEG) or output.get("data", {}).get(_PNG)
            if held:
                image = _decode(base64.b64decode(held))
                height = round(image.shape[0] * _GALLERY_WIDTH / image.shape[1])
                small = cv2.resize(image, (_GALLERY_WIDTH, height), interpolation=cv2.INTER_AREA)
                GALLERY.mkdir(parents=True, exist_ok=True)
                (GALLERY / f"{name}.jpg").write_bytes(_encode(small, ".jpg"))
                return


def main() -> None:
    """Run and save the notebooks of the given numbers, or all."""
    parser = argparse.ArgumentParser(description="Run the notebooks and save their results.")
    parser.add_argument(
        "numbers", nargs="*", type=int, help="numbers of the notebooks; all if none"
    )
    parser.add_argument("--timings", action="store_true", help="save measured times anew")
    chosen = parser.parse_args()
    for path in notebooks():
        if chosen.numbers and int(path.name[:2]) not in chosen.numbers:
            continue
        began = time.perf_counter()
        notebook = run(path)
        tidy(notebook, read(path), timings=chosen.timings)
        text = nbformat.writes(notebook)  # type: ignore[no-untyped-call]
        path.write_text(text.rstrip("\n") + "\n", encoding="utf-8")
        save_gallery(notebook, path.stem)
        size = path.stat().st_size
        print(f"{path.name}: {time.perf_counter() - began:.0f} s, {size / 1e3:,.0f} kB", flush=True)
        if size > MOST_BYTES:
            raise SystemExit(f"{path.name} is larger than {MOST_BYTES / 1e6} MB: draw less in it")


if __name__ == "__main__":
    main()
