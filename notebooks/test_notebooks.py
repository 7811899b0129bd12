"""Every notebook runs without errors, and its saved outputs are complete and not private."""

import ast
import os
import re
from pathlib import Path

import pytest

import refresh

NOTEBOOKS = refresh.notebooks()
EACH = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)


def code_of(path):
    return [cell for cell in refresh.read(path).cells if cell.cell_type == "code"]


def markdown_of(path):
    return [cell.source for cell in refresh.read(path).cells if cell.cell_type == "markdown"]


def texts_in(cell):
    for output in cell.outputs:
        yield output.get("text", "")
        for kind, data in output.get("data", {}).items():
            if kind.startswith("text/") and "base64," not in data:
                yield data


def test_the_notebooks_are_numbered():
    assert [path.name[:2] for path in NOTEBOOKS] == [f"{number:02}" for number in range(1, 12)]


@EACH
def test_it_runs_on_rendered_data(path):
    refresh.run(path)


@pytest.mark.realdata
@EACH
def test_it_runs_on_real_data(path):
    folder = os.environ.get("VEHICLE_DETECTION_DATA")
    if not folder:
        pytest.skip("VEHICLE_DETECTION_DATA is not set")
    refresh.run(path, data=folder)


@EACH
def test_it_starts_with_its_contents_and_ends_with_a_link_to_the_next(path):
    cells = markdown_of(path)
    assert cells[0].startswith(f"# {int(path.name[:2])}. ")
    assert "*What you learn:*" in cells[0]
    assert "## Things to try" in cells[-1]
    targets = [*(each.name for each in NOTEBOOKS[1:]), "README.md"]
    assert targets[NOTEBOOKS.index(path)] in cells[-1].splitlines()[-1]
    assert refresh.read(path).cells[-1].cell_type == "markdown"


@EACH
def test_its_last_code_cell_checks_the_results(path):
    body = ast.parse(code_of(path)[-1].source).body
    assert sum(isinstance(node, ast.Assert) for node in ast.walk(ast.Module(body, []))) >= 4


@EACH
def test_links_have_a_target(path):
    for link in re.findall(r"\]\(([^)#]+)\)", "\n".join(markdown_of(path))):
        assert link.startswith("https://") or (path.parent / link).exists(), link


def test_the_gallery_shows_all_notebooks():
    page = (refresh.HERE / "README.md").read_text(encoding="utf-8")
    for link in re.findall(r'\]\(([^)]+)\)|src="([^"]+)"', page):
        assert (refresh.HERE / "".join(link)).exists(), link
    for path in NOTEBOOKS:
        assert f"({path.name})" in page
        assert f"gallery/{path.stem}.jpg" in page


@EACH
def test_it_was_saved_after_a_complete_run(path):
    assert path.stat().st_size <= refresh.MAX_BYTES
    cells = code_of(path)
    assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1))
    shown = [output for cell in cells for output in cell.outputs]
    assert not [output for output in shown if output.output_type == "error"]
    assert not [output for output in shown if output.get("name") == "stderr"]
    assert any("image/" in kind for output in shown for kind in output.get("data", {}))


@EACH
def test_it_contains_no_paths_of_the_machine_that_saved_it(path):
    notebook = refresh.read(path)
    assert set(notebook.metadata) == {"kernelspec", "language_info"}
    assert all(set(cell.metadata) <= {"tags"} for cell in notebook.cells)
    private = {str(refresh.HERE.parent), str(Path.home()), "/tmp/", "site-packages"}
    for cell in code_of(path):
        for text in texts_in(cell):
            assert not [word for word in private if word != "/" and word in text], text[:200]
            # memory addresses differ between runs
            assert not re.search(r"0x[0-9a-f]{8,}", text), text[:200]


def test_measured_times_are_kept_while_the_rest_is_unchanged():
    path = NOTEBOOKS[4]
    committed, again = refresh.read(path), refresh.read(path)
    timed = [cell for cell in again.cells if "timing" in refresh.tags(cell)]
    assert timed
    for cell in timed:
        cell.outputs = []
    refresh.tidy(again, committed)
    assert all(cell.outputs for cell in timed)

    for cell in timed:
        cell.outputs = []
    again.cells[1].source += "\n"
    refresh.tidy(again, committed)
    assert not any(cell.outputs for cell in timed)


def test_failures_and_timeouts_are_reported(tmp_path):
    import nbformat
    from nbclient.exceptions import CellExecutionError

    def saved(source):
        path = tmp_path / "one.ipynb"
        cells = [nbformat.v4.new_code_cell(source)]
        nbformat.write(nbformat.v4.new_notebook(cells=cells), path)
        return path

    with pytest.raises(CellExecutionError, match="assert 1 > 2"):
        refresh.run(saved("assert 1 > 2"))
    with pytest.raises(RuntimeError, match="writes to standard error"):
        refresh.run(saved("import sys; sys.stderr.write('careful')"))
    with pytest.raises(TimeoutError):
        refresh.run(saved("import time; time.sleep(60)"), max_seconds=5)
    assert "VEHICLE" not in str(
        refresh.run(saved("import os; os.environ.get('VEHICLE_DETECTION_DATA')")).cells[0].outputs
    )
