"""Run the notebooks and save them with their outputs.

``python notebooks/refresh.py`` runs all notebooks, ``python notebooks/refresh.py 4 7`` two of them,
each in its own kernel, on the rendered data (`VEHICLE_DETECTION_DATA` is ignored). Execution times
and widgets are not saved, so a second run changes nothing. Cells with the tag ``timing`` show
measured times: they keep their saved outputs while the rest of the notebook is unchanged, unless
``--timings`` is given.

The first image of a cell with the tag ``gallery`` is also written to ``docs/gallery``.
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

MAX_SECONDS = 240
MAX_BYTES = 1_500_000
"""Limits of the run time and the file size of a notebook."""

_PNG, _JPEG = "image/png", "image/jpeg"
_JPEG_QUALITY = 86
_GALLERY_WIDTH = 640
_METADATA = {
    "kernelspec": {"display_name": "Python 3 (ipykernel)", "language": "python", "name": "python3"},
    "language_info": {"name": "python"},
}


def notebooks() -> list[Path]:
    """Return the paths of the notebooks in order."""
    return sorted(HERE.glob("[0-9]*.ipynb"))


def read(path: Path) -> Any:
    """Read a notebook."""
    return nbformat.read(path, as_version=4)  # type: ignore[no-untyped-call]


def run(path: Path, *, data: str | None = None, max_seconds: float = MAX_SECONDS) -> Any:
    """Run a notebook on the rendered data, or on the real data in a folder.

    Raises
    ------
    nbclient.exceptions.CellExecutionError
        If a cell raises an exception, such as a failed assert.
    RuntimeError
        If a cell writes to standard error, such as a warning.
    TimeoutError
        If it takes longer than `max_seconds`.
    """
    # Run as for a reader, without the settings of this shell.
    excluded = ("VEHICLE_DETECTION_DATA", "MPLBACKEND")
    environment = {name: value for name, value in os.environ.items() if name not in excluded}
    if data is not None:
        environment["VEHICLE_DETECTION_DATA"] = data
    notebook = read(path)
    deadline = time.monotonic() + max_seconds
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
    """Return a cell's tags."""
    return list(cell.metadata.get("tags", []))


def tidy(notebook: Any, committed: Any, *, timings: bool = False) -> None:
    """Remove what differs between runs from an executed notebook."""
    notebook.metadata = nbformat.from_dict(_METADATA)
    for cell in _code(notebook):
        cell.metadata = nbformat.from_dict({"tags": tags(cell)} if tags(cell) else {})
        cell.outputs = [output for output in cell.outputs if not _is_widget(output)]
        for output in cell.outputs:
            if _PNG in output.get("data", {}):
                _compress(output.data)
    if timings or _without_times(notebook) != _without_times(committed):
        return
    for cell, old in zip(_code(notebook), _code(committed)):
        if "timing" in tags(cell) and old.outputs:
            cell.outputs = old.outputs


def _without_times(notebook: Any) -> list[Any]:
    """Return all sources and outputs except measured times."""
    return [
        (cell.source, None if "timing" in tags(cell) else cell.outputs) for cell in _code(notebook)
    ]


def _is_widget(output: Any) -> bool:
    return any("widget" in kind for kind in output.get("data", {}))


def _compress(data: Any) -> None:
    """Replace a PNG by a JPEG of less than half its size: photographs, not charts."""
    png = base64.b64decode(data[_PNG])
    jpeg = _encode(_decode(png), ".jpg")
    if len(jpeg) < 0.5 * len(png):
        del data[_PNG]
        data[_JPEG] = base64.b64encode(jpeg).decode("ascii")


def _decode(data: bytes) -> Any:
    return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)


def _encode(image: Any, suffix: str) -> bytes:
    return bytes(cv2.imencode(suffix, image, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1])


def save_gallery(notebook: Any, name: str) -> None:
    """Write the first image of the cell with the tag ``gallery``."""
    for cell in _code(notebook):
        if "gallery" not in tags(cell):
            continue
        for output in cell.outputs:
            data = output.get("data", {})
            encoded = data.get(_JPEG) or data.get(_PNG)
            if encoded:
                image = _decode(base64.b64decode(encoded))
                height = round(image.shape[0] * _GALLERY_WIDTH / image.shape[1])
                small = cv2.resize(image, (_GALLERY_WIDTH, height), interpolation=cv2.INTER_AREA)
                GALLERY.mkdir(parents=True, exist_ok=True)
                (GALLERY / f"{name}.jpg").write_bytes(_encode(small, ".jpg"))
                return


def main() -> None:
    """Run and save the selected notebooks."""
    parser = argparse.ArgumentParser(description="Run the notebooks and save their outputs.")
    parser.add_argument("numbers", nargs="*", type=int, help="notebooks to run; default: all")
    parser.add_argument("--timings", action="store_true", help="replace saved measured times")
    arguments = parser.parse_args()
    for path in notebooks():
        if arguments.numbers and int(path.name[:2]) not in arguments.numbers:
            continue
        start = time.perf_counter()
        notebook = run(path)
        tidy(notebook, read(path), timings=arguments.timings)
        text = nbformat.writes(notebook)  # type: ignore[no-untyped-call]
        path.write_text(text.rstrip("\n") + "\n", encoding="utf-8")
        save_gallery(notebook, path.stem)
        size = path.stat().st_size
        print(f"{path.name}: {time.perf_counter() - start:.0f} s, {size / 1e3:,.0f} kB", flush=True)
        if size > MAX_BYTES:
            raise SystemExit(f"{path.name} is larger than {MAX_BYTES / 1e6} MB: reduce its images")


if __name__ == "__main__":
    main()
