#!/usr/bin/env python3
"""Runs the commands of the README and of the tutorials as a newcomer would, and reports each block.

    scripts/newcomer.py                                 # all pages, after `make build`
    scripts/newcomer.py docs/tutorials/your-reward.md   # one page

Every page starts in an empty directory that has only `.venv`, with a PATH without `caraware`. Its blocks run in order,
in one shell: a block keeps the directory and the variables of the one before it.

- A block `sh` or `python` runs as it is written.
- A block of any language whose first line is `# NAME.EXTENSION` is written to that file instead.
- A line that begins with `make` or `apt-get` does not run: the first has been run, the second needs root.

A comment before a block changes what happens to it:

    <!-- newcomer: add ARGS -->         adds arguments to its `caraware train`, `simulate` and `play`, to make it short
    <!-- newcomer: replace A by B -->   replaces a text, to make it short
    <!-- newcomer: background -->       runs it until the page ends, as in a terminal of its own; then comes Ctrl-C
    <!-- newcomer: wait FILE -->        waits until the file exists
    <!-- newcomer: skip REASON -->      does not run it
"""

import os
import re
import shlex
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
BLOCK_LIMIT_S = 120.0
"""Longest time of a block, of a wait, and of an end after Ctrl-C."""
SKIPPED_COMMANDS = ("make", "apt-get")
MARKER = re.compile(r"<!-- newcomer: (add|replace|background|wait|skip)\s*(.*?)\s*-->")
FILE_NAME = re.compile(r"# ([\w.-]+\.(?:py|toml|xml|csv))$")


@dataclass
class Block:
    """A code block of a page with what the markers before it say."""

    line: int
    """Number of its first line in the page, from 1."""
    language: str
    text: str
    added: str = ""
    replaced: list[tuple[str, str]] = field(default_factory=list)
    is_background: bool = False
    awaited: str = ""
    skip_reason: str = ""

    @property
    def file_name(self) -> str | None:
        """Name of the file that the block is, if it is one."""
        match = FILE_NAME.match(self.text.split("\n", 1)[0])
        return match[1] if match else None

    @property
    def runs(self) -> bool:
        """True if the block is a script."""
        return self.language in ("sh", "python") and not self.skip_reason and self.file_name is None

    def script(self) -> str:
        """The text that runs."""
        text = self.text
        for old, new in self.replaced:
            if old not in text:
                raise ValueError(f"line {self.line}: the block has no {old!r} to replace")
            text = text.replace(old, new)
        if self.language == "python":
            return text
        lines = text.replace("\\\n", " ").splitlines()
        return "\n".join(self._shortened(line) for line in lines if line.split(" ")[0] not in SKIPPED_COMMANDS)

    def _shortened(self, line: str) -> str:
        command, mark, comment = line.partition("  #")
        is_run = re.search(r"(caraware (train|simulate|play)|caraware\.parallel)\b", command)
        return f"{command.rstrip()} {self.added}{mark}{comment}" if self.added and is_run else line


def blocks_of(page: Path) -> list[Block]:
    """The code blocks of a page, in order."""
    blocks: list[Block] = []
    markers: list[tuple[str, str]] = []
    block: Block | None = None
    for number, line in enumerate(page.read_text().splitlines(), 1):
        if block is not None:
            if line.startswith("```"):
                blocks.append(block)
                block = None
            else:
                block.text += line + "\n"
        elif line.startswith("```"):
            block = Block(number, line[3:].strip(), "")
            for kind, words in markers:
                mark(block, kind, words)
            markers = []
        else:
            markers += MARKER.findall(line)
    if markers:
        raise ValueError(f"{page}: a marker without a block")
    return blocks


def mark(block: Block, kind: str, words: str) -> None:
    """Apply a marker to the block behind it."""
    match kind:
        case "add":
            block.added = words
        case "replace":
            old, _, new = words.partition(" by ")
            block.replaced.append((old, new))
        case "background":
            block.is_background = True
        case "wait":
            block.awaited = words
        case "skip":
            block.skip_reason = words


class Shell:
    """A newcomer's terminal in a directory: what one block sets, the next one finds."""

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self.background: list[subprocess.Popen[str]] = []
        (directory / ".venv").symlink_to(ROOT / ".venv")
        self._state = directory / ".newcomer-state"
        self._state.write_text(f"cd {shlex.quote(str(directory))}\n")

    def run(self, block: Block) -> tuple[bool, str]:
        """Run a block: true if it succeeded, and what it printed."""
        if block.file_name is not None:
            (self.directory / block.file_name).write_text(block.text)
            return True, ""
        if block.awaited:
            self._wait_for(self.directory / block.awaited)
        script = block.script()
        if block.language == "python":
            (self.directory / ".newcomer.py").write_text(script)
            script = f"python {shlex.quote(str(self.directory / '.newcomer.py'))}"
        # `-e` ends at the first command that fails. The state is kept only by a block that succeeds.
        text = f". {self._state}\nset -e\n{script}\nset +e\n(export -p; printf 'cd %q\\n' \"$PWD\") > {self._state}\n"
        process = subprocess.Popen(
            ["bash", "-c", text],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            env=clean_environment(self.directory),
            start_new_session=True,
        )
        if block.is_background:
            self.background.append(process)
            return True, ""
        try:
            output, _ = process.communicate(timeout=BLOCK_LIMIT_S)
        except subprocess.TimeoutExpired:
            return False, self._end(process) + f"\nstill ran after {BLOCK_LIMIT_S:.0f} s"
        return process.returncode == 0, output

    def close(self) -> list[str]:
        """Press Ctrl-C in the other terminals; the outputs of those that fail then."""
        failures = []
        for process in self.background:
            output = self._end(process)
            if process.returncode not in (0, 130, -signal.SIGINT):
                failures.append(f"{output}\nexit status {process.returncode}")
        return failures

    def _end(self, process: subprocess.Popen[str]) -> str:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGINT)
        try:
            return process.communicate(timeout=BLOCK_LIMIT_S)[0]
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            return process.communicate()[0]

    def _wait_for(self, path: Path) -> None:
        deadline = time.monotonic() + BLOCK_LIMIT_S
        while not path.exists():
            if any(process.poll() not in (None, 0) for process in self.background):
                return
            if time.monotonic() > deadline:
                return
            time.sleep(0.1)


def clean_environment(directory: Path) -> dict[str, str]:
    """The variables of a new terminal: no environment is active, and no directory of PATH has `caraware`.

    The page has a registry of its own, so that live runs of the same names elsewhere on the machine are not meant.
    """
    variables = {key: value for key, value in os.environ.items() if key not in ("VIRTUAL_ENV", "PYTHONPATH")}
    variables["CARAWARE_RUNTIME_DIR"] = str(directory / ".registry")
    directories = variables["PATH"].split(os.pathsep)
    variables["PATH"] = os.pathsep.join(name for name in directories if not (Path(name) / "caraware").exists())
    return variables


def run_page(page: Path) -> tuple[int, float]:
    """Run the blocks of a page and print a line for each: the number of failures, and the seconds."""
    failures, begin = 0, time.monotonic()
    name = page.relative_to(ROOT) if page.is_relative_to(ROOT) else page
    with tempfile.TemporaryDirectory(prefix="newcomer-") as directory:
        shell = Shell(Path(directory))
        for block in blocks_of(page):
            if block.skip_reason:
                print(f"skipped           {name}:{block.line}: {block.skip_reason}")
            if block.skip_reason or not (block.runs or block.file_name):
                continue
            if block.runs and not block.script().strip():
                print(f"skipped           {name}:{block.line}: {', '.join(SKIPPED_COMMANDS)}")
                continue
            started = time.monotonic()
            is_good, output = shell.run(block)
            state = "background" if block.is_background else "ok" if is_good else "FAILED"
            print(f"{state:10} {time.monotonic() - started:5.1f} s {name}:{block.line}", flush=True)
            if "--show" in sys.argv or not is_good:
                print(output)
            if not is_good:
                failures += 1
                break
        for output in shell.close():
            print(f"FAILED in the background, {name}:\n{output}")
            failures += 1
    return failures, time.monotonic() - begin


def main() -> int:
    """Run the pages that the command line names, or all."""
    named = [Path(word).resolve() for word in sys.argv[1:] if not word.startswith("--")]
    pages = named or [ROOT / "README.md", *sorted((ROOT / "docs" / "tutorials").glob("*.md"))]
    if not named:
        left_out = sorted(page.stem for page in (ROOT / "docs").glob("*.md"))
        print(f"not followed, but their command lines are parsed (--test tree documentation::): docs/ {', '.join(left_out)}")
    results = [run_page(page) for page in pages]
    failures, seconds = sum(count for count, _ in results), sum(time_s for _, time_s in results)
    print(f"{len(pages)} pages in {seconds:.0f} s, {failures} failures")
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
