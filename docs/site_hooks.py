"""What MkDocs is told about this repository: its front page, and files outside of docs/.

README.md is the site's first page, with its links bent accordingly. A link of a page to a file of
the repository, such as ``../components/algorithms/lion.py``, works in the site, too: the file is
copied into it as text, below ``source/``. A link to nothing is left to MkDocs, whose strict build
refuses it.
"""

import posixpath
import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

_ROOT = Path(__file__).resolve().parents[1]
_FRONT = "index.md"
_LINK = re.compile(r'(\]\(|src="|href=")([^)\s"]+)')
_ELSEWHERE = re.compile(r"[a-z]+:|#|/")  # a scheme, an anchor of the page, an absolute path


class _Text(File):
    """A file that is copied as it is, even if its name is that of a page."""

    def is_documentation_page(self) -> bool:
        return False


def on_files(files: Files, *, config: Any) -> Files:
    """Make README.md the first page."""
    text = (_ROOT / "README.md").read_text(encoding="utf-8")
    files.append(File.generated(config, _FRONT, content=_LINK.sub(_from_docs, text)))
    return files


def on_page_markdown(markdown: str, *, page: Any, config: Any, files: Files) -> str:
    """Let links lead to README.md as the first page, and to files outside of docs/ as text."""
    markdown = markdown.replace("](../README.md", f"]({_FRONT}")
    for _, link in _LINK.findall(markdown):
        path = posixpath.normpath(link.partition("#")[0])
        file = _ROOT / "docs" / path
        if path.startswith("../") and file.is_file() and path not in files.src_uris:
            place = f"source/{path.removeprefix('../')}.txt"
            files.append(_Text(path, str(_ROOT / "docs"), config.site_dir, False, dest_uri=place))
    return markdown


def _from_docs(link: re.Match[str]) -> str:
    """A link of README.md as it stands in docs/."""
    opening, target = link.groups()
    if _ELSEWHERE.match(target):
        return f"{opening}{target}"
    return f"{opening}{posixpath.relpath(target, 'docs') if target != 'docs' else '.'}"
