"""Pages of the repository outside docs/ as pages of the site, and the links between all of them.

Links in Markdown files are relative to the file, so that they work wherever the repository is read.
In the site those files lie elsewhere, and their links are changed as they are read.
"""

import os
import re
import shutil
from pathlib import Path, PurePosixPath

REPOSITORY = Path(__file__).parents[1]
GENERATED = PurePosixPath("generated")
PAGES = (  # README.md is not among them: index.md is its counterpart
    "ARCHITECTURE.md",
    "CHANGELOG.md",
    "CODE_OF_CONDUCT.md",
    "CONTRIBUTING.md",
    "CONVENTIONS.md",
    "SECURITY.md",
    "benchmarks/results/*.md",
    "data_specs/README.md",
    "design/*.md",
)
LINK = re.compile(r"(?<=\]\()([^)\s:#]+)(?=[)#])")  # to a file, without its anchor


def write(folder: Path) -> None:
    """Copy the pages into ``folder``, under their paths in the repository."""
    shutil.rmtree(folder, ignore_errors=True)
    for pattern in PAGES:
        for page in REPOSITORY.glob(pattern):
            copy = folder / page.relative_to(REPOSITORY)
            copy.parent.mkdir(parents=True, exist_ok=True)
            text = page.read_text(encoding="utf-8")
            if page.name == "README.md" and page.parent.name != "data_specs":  # leads to its folder
                text += "\n```{toctree}\n:hidden:\n:glob:\n\n*\n```\n"
            copy.write_text(text, encoding="utf-8")


def resolve_links(_app, docname: str, source: list[str]) -> None:
    """Replace links to files of the repository by links to their pages (Sphinx: source-read)."""
    page = PurePosixPath(docname)
    copied = page.is_relative_to(GENERATED)
    home = page.relative_to(GENERATED) if copied else PurePosixPath("docs") / page

    def resolved(match: re.Match) -> str:
        target = os.path.normpath(home.parent / match[1])
        return os.path.relpath(place_of(target), page.parent)

    if not copied or (REPOSITORY / f"{home}.md").exists():
        source[0] = LINK.sub(resolved, source[0])


def place_of(target: str) -> PurePosixPath:
    """Where a file of the repository is in the site, relative to docs/."""
    path = PurePosixPath(target)
    if target == "README.md":
        return PurePosixPath("index.md")
    if path.is_relative_to("docs"):
        return path.relative_to("docs")
    if any(path.match(pattern) for pattern in PAGES):
        return GENERATED / path
    return PurePosixPath("..") / path  # a file to download
