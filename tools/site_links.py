"""Check the links of the built documentation site: ``python -m tools.site_links OUT``."""

from __future__ import annotations

import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit


class _Page(HTMLParser):
    """Collects the relative links of a page and the places that links can name."""

    def __init__(self) -> None:
        super().__init__()
        self.links: list[str] = []
        self.anchors = {""}

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = dict(attrs)
        self.anchors.update(value for name in ("id", "name") if (value := values.get(name)))
        for name in ("href", "src"):
            link = values.get(name)
            if link and not urlsplit(link).scheme and not link.startswith("//"):
                self.links.append(link)


def read_page(path: Path) -> _Page:
    """Return links and anchors of an HTML page."""
    page = _Page()
    page.feed(path.read_text())
    return page


def find_broken_links(site: Path) -> list[str]:
    """Return the relative links whose file or anchor is missing, as ``page: link``.

    Parameters
    ----------
    site : Path
        Folder of HTML pages.
    """
    paths = [path for path in sorted(site.rglob("*.html")) if "_static" not in path.parts]
    pages = {path.resolve(): read_page(path) for path in paths}
    broken = []
    for path, page in pages.items():
        for link in page.links:
            parts = urlsplit(link)
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            anchors = pages[target].anchors if target in pages else {unquote(parts.fragment)}
            if not target.exists() or unquote(parts.fragment) not in anchors:
                broken.append(f"{path.relative_to(site.resolve())}: {link}")
    return broken


def main(site: str) -> int:
    """Print broken links; return the exit code."""
    if not list(Path(site).rglob("*.html")):
        print(f"no HTML page in {site}; build the site first", file=sys.stderr)
        return 2
    broken = find_broken_links(Path(site))
    print("\n".join(broken) if broken else "all links resolve")
    return int(bool(broken))


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
