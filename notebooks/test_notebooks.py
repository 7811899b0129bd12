"""Every notebook runs to its last assert, and what is saved in it may be shown to anybody."""

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


def words_of(path):
    return [cell.source for cell in refresh.read(path).cells if cell.cell_type == "markdown"]


def texts_in(cell):
    for output in cell.outputs:
        yield output.get("text", "")
        for kind, data in output.get("data", {}).items():
            if kind.startswith("text/") and "base64," not in data:
                yield data


def test_there_are_ten():
    assert [path.name[:2] for path in NOTEBOOKS] == [f"{number:02}" for number in range(1, 11)]


@EACH
def test_it_runs_on_what_the_project_draws(path):
    refresh.run(path)


@pytest.mark.realdata
@EACH
def test_it_runs_on_the_real_data(path):
    folder = os.environ.get("VEHICLE_DETECTION_DATA")
    if not folder:
        pytest.skip("VEHICLE_DETECTION_DATA is not set: the real data is not at hand")
    refresh.run(path, data=folder)


@EACH
def test_it_begins_with_what_one_learns_and_ends_with_the_next(path):
    words = words_of(path)
    assert words[0].startswith(f"# {int(path.name[:2])}. ")
    assert "*What you learn:*" in words[0]
    assert "## Things to try" in words[-1]
    following = NOTEBOOKS[(NOTEBOOKS.index(path) + 1) % len(NOTEBOOKS)].name
    last = words[-1].splitlines()[-1]
    assert (following if following != NOTEBOOKS[0].name else "README.md") in last
    assert refresh.read(path).cells[-1].cell_type == "markdown"


@EACH
def test_its_last_code_checks_what_the_reader_should_have_seen(path):
    body = ast.parse(code_of(path)[-1].source).body
    assert sum(isinstance(node, ast.Assert) for node in ast.walk(ast.Module(body, []))) >= 4


@EACH
def test_links_lead_somewhere(path):
    for link in re.findall(r"\]\(([^)#]+)\)", "\n".join(words_of(path))):
        assert link.startswith("https://") or (path.parent / link).exists(), link


def test_the_gallery_shows_all():
    page = (refresh.HERE / "README.md").read_text(encoding="utf-8")
    for link in re.findall(r'\]\(([^)]+)\)|src="([^"]+)"', page):
        assert (refresh.HERE / "".join(link)).exists(), link
    for path in NOTEBOOKS:
        assert f"({path.name})" in page
        assert f"gallery/{path.stem}.jpg" in page


@EACH
def test_it_was_saved_after_a_whole_run(path):
    assert path.stat().st_size <= refresh.MOST_BYTES
    cells = code_of(path)
    assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1))
    shown = [output for cell in cells for output in cell.outputs]
    assert not [output for output in shown if output.output_type == "error"]
    assert not [output for output in shown if output.get("name") == "stderr"]
    assert any("image/" in kind for output in shown for kind in output.get("data", {}))


@EACH
def test_it_tells_nothing_of_the_machine_it_was_saved_on(path):
    notebook = refresh.read(path)
    assert set(notebook.metadata) == {"kernelspec", "language_info"}
    assert all(set(cell.metadata) <= {"tags"} for cell in notebook.cells)
    private = {str(refresh.HERE.parent), str(Path.home()), "/tmp/", "site-packages"}
    for cell in code_of(path):
        for text in texts_in(cell):
            assert not [word for word in private if word != "/" and word in text], text[:200]
            # An address in memory is another one in every run.
            assert not re.search(r"0x[0-9a-f]{8,}", text), text[:200]


def test_measured_times_are_kept_until_something_else_changes():
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


def test_a_notebook_that_fails_or_takes_too_long_is_noticed(tmp_path):
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
        refresh.run(saved("import time; time.sleep(60)"), limit=5)
    assert "VEHICLE" not in str(
        refresh.run(saved("import os; os.environ.get('VEHICLE_DETECTION_DATA')")).cells[0].outputs
    )
