"""Builds the website of all pages into `target/site/html`: `make site`.

The pages link to each other and to source files as on GitHub. So the site is made from a copy of the repository's
layout that has every page and every file that a page links to, and no link is rewritten but those to a directory.
A link or an anchor that leads nowhere fails the build, and so does a page that `NAVIGATION` does not list.
"""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
SITE = ROOT / "target" / "site"
SOURCE = SITE / "source"
LINK = re.compile(r"\]\(([^)#\s]+)(#[^)\s]*)?\)")
SKIPPED = {"target", "runs", "node_modules"}
"""Directories without pages of the project."""
INCLUDED = {"docs/benchmarks/parts.md"}
"""Pages that are a part of another one."""

NAVIGATION = {
    "First steps": [
        "docs/capabilities",
        "docs/install",
        "docs/peers",
        "docs/glossary",
        "configs/README",
        "maps/town/README",
        "maps/avenue/README",
        "maps/valley/README",
    ],
    "Tutorials": [
        "docs/tutorials/your-scenario",
        "docs/tutorials/your-reward",
        "docs/tutorials/your-network",
        "docs/tutorials/your-sensor",
        "docs/tutorials/a-handover-in-mid-run",
        "docs/tutorials/watch-from-a-laptop",
        "docs/tutorials/a-data-set",
        "docs/tutorials/many-machines",
    ],
    "Traffic and vehicles": ["docs/import", "docs/traci", "docs/vehicle-model", "docs/scene", "docs/driving"],
    "Sensors and messages": [
        "docs/sensor-models",
        "docs/lidar",
        "docs/camera",
        "docs/suites",
        "docs/seeing",
        "docs/detector",
        "docs/v2x",
    ],
    "Learning": [
        "docs/environments",
        "docs/learners",
        "docs/networks",
        "docs/baselines",
        "docs/fusion",
        "docs/cooperation",
        "docs/messages",
        "docs/curriculum",
        "docs/parallel",
        "docs/trials",
        "docs/cluster",
        "docs/paper",
        "docs/reproduce",
    ],
    "Watching and recording": [
        "docs/viewer",
        "docs/panel",
        "docs/remote",
        "docs/fanout",
        "docs/metrics",
        "docs/recording",
        "docs/run-directory",
    ],
    "Inside": ["ARCHITECTURE", "docs/extending", "docs/benchmarks", "docs/decisions/README"],
}
"""The menu: heading -> pages, by their paths without `.md`."""


def pages() -> list[Path]:
    """Every page of the working tree, relative to its root."""
    found: list[Path] = []
    for directory, names, files in os.walk(ROOT):
        names[:] = [name for name in names if not name.startswith(".") and name not in SKIPPED]
        found += [Path(directory, file).relative_to(ROOT) for file in files if file.endswith(".md")]
    return sorted(page for page in found if str(page) not in INCLUDED)


def target_of(page: Path, link: str) -> str:
    """What a link of a page leads to: a file stays, a directory is its page or its module."""
    linked = ROOT / page.parent / link
    if not linked.is_dir():
        return link
    if linked == ROOT / "docs" / "decisions":
        return f"{link}/README.md"
    names = [name for name in ("README.md", "__init__.py") if (linked / name).exists()]
    return f"{link.rstrip('/')}/{names[0]}" if names else link


def stage(page: Path) -> None:
    """Copy a page and the files that it links to."""

    def follow(match: re.Match[str]) -> str:
        link, anchor = match[1], match[2] or ""
        if "://" in link:
            return match[0]
        target = target_of(page, link)
        file = Path(os.path.normpath(page.parent / target))
        if file.suffix != ".md" and (ROOT / file).is_file():
            (SOURCE / file).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(ROOT / file, SOURCE / file)
        return f"]({target}{anchor})"

    copy = SOURCE / page
    copy.parent.mkdir(parents=True, exist_ok=True)
    copy.write_text(LINK.sub(follow, (ROOT / page).read_text()))


def stage_decisions(decisions: list[Path]) -> None:
    """The page that lists the decisions."""
    names = "\n".join(page.stem for page in decisions)
    text = f"# Decisions\n\nEach page has one decision with its reasons.\n\n```{{toctree}}\n{names}\n```\n"
    (SOURCE / "docs" / "decisions" / "README.md").write_text(text)


def stage_menu() -> None:
    """The README is the first page; the menu stands behind it."""
    menus = [
        f"```{{toctree}}\n:hidden:\n:caption: {heading}\n\n" + "\n".join(names) + "\n```\n"
        for heading, names in NAVIGATION.items()
    ]
    with (SOURCE / "README.md").open("a") as readme:
        readme.write("\n" + "\n".join(menus))


def main() -> int:
    """Stage the pages and build them, with warnings as errors."""
    shutil.rmtree(SITE, ignore_errors=True)
    for page in pages():
        stage(page)
    stage_decisions([page for page in pages() if page.parent == Path("docs/decisions")])
    stage_menu()
    command = [sys.executable, "-m", "sphinx", "--fail-on-warning", "--keep-going", "--quiet", "--jobs", "auto"]
    command += ["--conf-dir", str(Path(__file__).parent), str(SOURCE), str(SITE / "html")]
    status = subprocess.run(command, check=False).returncode
    if status == 0:
        shutil.copyfile(SITE / "html" / "README.html", SITE / "html" / "index.html")
        print(f"{len(pages())} pages: {SITE / 'html' / 'index.html'}")
    return status


if __name__ == "__main__":
    sys.exit(main())
