"""The pages that are generated for the documentation site, its links, and the code in the documentation."""

import ast
import inspect
import re
import shlex
from pathlib import Path

import pytest
import typer.main

import vehicle_detection
from tools import site_links, site_pages
from vehicle_detection.cli.app import app

ROOT = Path(__file__).parents[2]
DOCUMENTS = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
BLOCKS = [
    (path.name, language, code)
    for path in DOCUMENTS
    for language, code in re.findall(r"^```(\w+)\n(.*?)^```", path.read_text(), re.MULTILINE | re.DOTALL)
]


class TestMoveLinks:
    @pytest.mark.parametrize(
        ("text", "source", "moved"),
        [
            ("[a](docs/camera.md)", "README.md", "[a](camera.md)"),
            ("[a](vehicle_detection/models/default.md)", "README.md", "[a](models/default.md)"),
            ("[a](sources.md#trips)", "docs/batch.md", "[a](sources.md#trips)"),
            ("[a](LICENSE)", "README.md", "[a](../LICENSE)"),
            ('<img src="../docs/picture.jpg">', "notebooks/README.md", '<img src="picture.jpg">'),
            (r"<img src=\"../docs/picture.jpg\">", "notebooks/README.md", r"<img src=\"picture.jpg\">"),
        ],
    )
    def test_links_to_files_hold_on_the_site(self, text, source, moved):
        assert site_pages.move_links(text, source, "docs/index.md") == moved

    @pytest.mark.parametrize(
        "link", ["https://example.org/a.md", "#a", "missing.md", "data:image/png;base64,A"]
    )
    def test_other_links_stay(self, link):
        assert site_pages.move_links(f"[a]({link})", "README.md", "docs/index.md") == f"[a]({link})"


class TestPages:
    def test_every_public_name_has_an_entry(self):
        pages = site_pages.api_pages()
        entries = re.findall(
            r"^\.\. auto(?:class|function|exception):: (?:\w+\.)*(\w+)$", "".join(pages.values()), re.M
        )
        modules = {
            name for name in vehicle_detection.__all__ if inspect.ismodule(getattr(vehicle_detection, name))
        }
        others = " ".join(site_pages.SUBPACKAGE_NAMES.values()).split()
        assert sorted(entries) == sorted([*{*vehicle_detection.__all__} - modules, *others])

    def test_a_name_without_a_page_is_an_error(self, monkeypatch):
        names = site_pages.public_names() | {"new": ["f"]}
        monkeypatch.setattr(site_pages, "public_names", lambda: names)
        message = "public names without a page: f; add their modules to API_PAGES"
        with pytest.raises(ValueError, match=message):
            site_pages.api_pages()

    def test_a_module_that_is_gone_is_an_error(self, monkeypatch):
        monkeypatch.setattr(site_pages, "public_names", lambda: names)
        names = {module: [] for _, _, modules in site_pages.API_PAGES for module in modules.split()}
        del names["camera"]
        message = r"no public names from camera; correct API_PAGES in tools\.site_pages"
        with pytest.raises(ValueError, match=message):
            site_pages.api_pages()

    def test_sections_of_the_readme_exist(self):
        text = (ROOT / "README.md").read_text()
        assert all(site_pages.read_section(text, title) for title in site_pages.README_SECTIONS)
        with pytest.raises(ValueError, match="no section 'B': change README_SECTIONS"):
            site_pages.read_section("## A\n", "B")

    def test_commands_are_described_in_full_and_arguments_without_types(self):
        page = """* `one`: Do one...

## `vehicle-detection one`

Do one thing with a file, and
another.

```console
$ vehicle-detection one [OPTIONS] {IMAGE...}... {LABELS.csv}
```

* `IMAGE... <list[Path]>`: Images.
* `LABELS.csv <path>`: Labels.
"""
        tidied = site_pages.tidy_commands(page)
        assert "* `one`: Do one thing with a file, and another.\n" in tidied
        assert "$ vehicle-detection one [OPTIONS] IMAGE... LABELS.csv\n" in tidied
        assert "* `IMAGE...`: Images.\n* `LABELS.csv`: Labels.\n" in tidied


class TestLinks:
    @pytest.mark.parametrize(
        ("link", "broken"),
        [
            *((link, False) for link in ("b.html#place", "b.html", "https://example.org/c.html", "#here")),
            *((link, True) for link in ("b.html#elsewhere", "c.html", "#elsewhere")),
        ],
    )
    def test_missing_files_and_anchors_are_found(self, tmp_path, capsys, link, broken):
        (tmp_path / "a.html").write_text(f'<p id="here"><a href="{link}">b</a></p>')
        (tmp_path / "b.html").write_text('<p id="place">')
        assert site_links.find_broken_links(tmp_path) == [f"a.html: {link}"] * broken
        assert site_links.main(str(tmp_path)) == broken
        assert capsys.readouterr().out

    def test_an_empty_folder_is_an_error(self, tmp_path, capsys):
        assert site_links.main(str(tmp_path)) == 2
        assert "no HTML page in" in capsys.readouterr().err


class TestRepository:
    @pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: path.name)
    def test_links_hold_in_the_repository(self, path):
        links = re.findall(r"\]\(([^)#\s:]+)(?:#[^)]*)?\)", path.read_text())
        missing = {link for link in links if not (path.parent / link).exists()}
        assert missing <= {"api/index.rst", "api/detect.rst", "cli.md"}  # generated


class TestCode:
    @pytest.mark.parametrize(
        ("page", "code"), [(page, code) for page, kind, code in BLOCKS if kind == "python"]
    )
    def test_python_blocks_are_valid_and_use_public_names(self, page, code):
        tree = ast.parse(code, page)
        used = {
            node.attr
            for node in ast.walk(tree)
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "vd"
        }
        assert used <= {*vehicle_detection.__all__}

    @pytest.mark.parametrize(
        ("page", "code"), [(page, code) for page, kind, code in BLOCKS if kind == "bash"]
    )
    def test_commands_and_their_options_exist(self, page, code):
        commands = typer.main.get_command(app).commands
        for line in code.replace("\\\n", " ").splitlines():
            words = shlex.split(line, comments=True)
            if "vehicle-detection" not in words or words[-1] == "vehicle-detection":
                continue
            name, *rest = words[words.index("vehicle-detection") + 1 :]
            known = {option for param in commands[name].params for option in param.opts} | {"--help"}
            used = {word.split("=")[0] for word in rest if word.startswith("--")}
            assert used <= known, f"{page}: {line}"
