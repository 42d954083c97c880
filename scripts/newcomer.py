#!/usr/bin/env python3
"""Runs the commands of README, docs and configs/README.md as a newcomer would, and reports each block.

    scripts/newcomer.py                                 # all pages, after `make build`
    scripts/newcomer.py docs/tutorials/your-reward.md   # one page
    scripts/newcomer.py --all                           # with the blocks that take long: `make newcomer`
    scripts/newcomer.py --list                          # what happens to each block; nothing runs

Every page starts in an empty directory that has only `.venv`, with a PATH without `caraware`. A page that activates the
environment nowhere presupposes it. The blocks of a page run in order, in one shell: a block keeps the directory and
the variables of the one before it.

- A block `sh` or `python` runs as it is written.
- A block of any language whose first line is `# NAME.EXTENSION` is written to that file instead.
- A line that begins with `make` or `apt-get` does not run: the first has been run, the second needs root.
- A block `python outline` leaves out what the reader has. It is compiled.

A comment before a block changes what happens to it:

    <!-- newcomer: add ARGS -->         adds arguments to its `caraware train`, `simulate` and `play`, to make it short
    <!-- newcomer: replace A by B -->   replaces a text, to make it short, or to give the reader's own names
    <!-- newcomer: first COMMAND -->    makes what the reader has: runs in the same shell before the block
    <!-- newcomer: checkout -->         runs it in the checkout
    <!-- newcomer: background -->       runs it until the page ends, as in a terminal of its own; then comes Ctrl-C
    <!-- newcomer: beside COMMAND -->   runs the command in a terminal of its own until the page ends
    <!-- newcomer: wait FILE -->        waits until the file exists
    <!-- newcomer: without LINE: REASON -->  does not run the lines that begin so
    <!-- newcomer: long REASON -->      runs it with `--all` alone
    <!-- newcomer: elsewhere TEST -->   does not run it, because a test reads the page and does
    <!-- newcomer: skip REASON -->      does not run it

What does not run is parsed: shell scripts by bash, Python by its compiler, the arguments of `caraware-viewer`, `bench`,
`reproduce` and `report` by these programs. Files, modules and targets that it names must exist. The supervisor's test
`documentation` parses every `caraware` command line with its settings.
"""

import contextlib
import io
import os
import re
import shlex
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from importlib import import_module
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PYTHON = ROOT / ".venv" / "bin" / "python"
BLOCK_LIMIT_S = 120.0
"""Longest time of a block, of a wait, and of an end after Ctrl-C."""
LONG_BLOCK_LIMIT_S = 1800.0
SKIPPED_COMMANDS = ("make", "apt-get")
CODE = ("sh", "python")
LANGUAGES = (*CODE, "toml", "text", "json")
"""What a block may be: the first word behind its fence."""
OUTLINE = "outline"
MARKERS = "add|replace|background|beside|wait|skip|first|checkout|without|long|elsewhere"
MARKER = re.compile(rf"<!-- newcomer: ({MARKERS})\b\s*(.*?)\s*-->")
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
    is_outline: bool = False
    is_background: bool = False
    beside: str = ""
    awaited: str = ""
    prepared: list[str] = field(default_factory=list)
    is_in_checkout: bool = False
    left_out: list[str] = field(default_factory=list)
    """Beginnings of lines that do not run."""
    long_reason: str = ""
    elsewhere: str = ""
    """The test that runs the block, a path in the checkout."""
    skip_reason: str = ""

    @property
    def file_name(self) -> str | None:
        """Name of the file that the block is, if it is one."""
        match = FILE_NAME.match(self.text.split("\n", 1)[0])
        return match[1] if match else None

    @property
    def is_code(self) -> bool:
        """True if the block is a script or a program."""
        return self.language in CODE and self.file_name is None

    def state(self, with_long: bool) -> str:
        """What happens to the block: `run`, or why not: `long`, `elsewhere`, `skip`, `make`, `outline`."""
        if self.skip_reason:
            return "skip"
        if self.elsewhere:
            return "elsewhere"
        if self.is_outline:
            return "outline"
        if self.long_reason and not with_long:
            return "long"
        return "run" if self.script().strip() else "make"

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
        return "\n".join(self._shortened(line) for line in lines if not self._is_left_out(line))

    def _is_left_out(self, line: str) -> bool:
        return line.split(" ")[0] in SKIPPED_COMMANDS or line.startswith(tuple(self.left_out))

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
            if line.lstrip().startswith("```"):
                blocks.append(block)
                block = None
            else:
                block.text += line + "\n"
        elif line.lstrip().startswith("```"):
            language, _, words = line.strip()[3:].partition(" ")
            block = Block(number, language, "", is_outline=words == OUTLINE)
            if language not in LANGUAGES or (language in CODE and line[0] != "`"):
                known = ", ".join(LANGUAGES)
                raise ValueError(f"{page}:{number}: a block begins with ``` and one of {known}; code is not indented")
            for kind, words in markers:
                mark(block, kind, words)
            markers = []
        else:
            markers += MARKER.findall(line)
            if "<!-- newcomer" in line and not MARKER.search(line):
                raise ValueError(f"{page}:{number}: no marker is called so: {line}")
    if markers:
        raise ValueError(f"{page}: a marker without a block")
    return blocks


def mark(block: Block, kind: str, words: str) -> None:
    """Apply a marker to the block behind it."""
    if not words and kind not in ("background", "checkout"):
        raise ValueError(f"line {block.line}: `{kind}` needs a text")
    match kind:
        case "add":
            block.added = words
        case "replace":
            old, _, new = words.partition(" by ")
            block.replaced.append((old, new))
        case "first":
            block.prepared.append(words)
        case "beside":
            block.beside = words
        case "checkout":
            block.is_in_checkout = True
        case "without":
            line, _, reason = words.partition(": ")
            if not reason:
                raise ValueError(f"line {block.line}: `without` needs a reason")
            block.left_out.append(line)
        case "background":
            block.is_background = True
        case "wait":
            block.awaited = words
        case "long":
            block.long_reason = words
        case "elsewhere":
            block.elsewhere = words
        case "skip":
            block.skip_reason = words


class Shell:
    """A newcomer's terminal in a directory: what one block sets, the next one finds."""

    def __init__(self, directory: Path, is_active: bool, limit_s: float) -> None:
        self.directory = directory
        self.limit_s = limit_s
        self.background: list[subprocess.Popen[str]] = []
        (directory / ".venv").symlink_to(ROOT / ".venv")
        self._state = directory / ".newcomer-state"
        begin = f"cd {shlex.quote(str(directory))}\n"
        self._state.write_text(begin + ". .venv/bin/activate\n" if is_active else begin)

    def run(self, block: Block) -> tuple[bool, str]:
        """Run a block: true if it succeeded, and what it printed."""
        if block.file_name is not None:
            (self.directory / block.file_name).write_text(block.text)
            return True, ""
        if block.beside:
            self.background.append(self._start(block.beside))
        if block.awaited:
            self._wait_for(self.directory / block.awaited)
        script = block.script()
        if block.language == "python":
            (self.directory / ".newcomer.py").write_text(script)
            script = f"python {shlex.quote(str(self.directory / '.newcomer.py'))}"
        if block.is_in_checkout:
            script = f"(cd {shlex.quote(str(ROOT))}\n{script}\n)"
        script = "\n".join([*block.prepared, script])
        process = self._start(script)
        if block.is_background:
            self.background.append(process)
            return True, ""
        try:
            output, _ = process.communicate(timeout=self.limit_s)
        except subprocess.TimeoutExpired:
            return False, self._end(process) + f"\nstill ran after {self.limit_s:.0f} s"
        return process.returncode == 0, output

    def _start(self, script: str) -> subprocess.Popen[str]:
        # `-e` ends at the first command that fails. The state is kept only by a block that succeeds.
        text = f". {self._state}\nset -e\n{script}\nset +e\n(export -p; printf 'cd %q\\n' \"$PWD\") > {self._state}\n"
        return subprocess.Popen(
            ["bash", "-c", text],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            env=clean_environment(self.directory),
            start_new_session=True,
        )

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

    The page has a registry of its own, so that live runs of the same names elsewhere on the machine are not meant. It
    also has a directory for the logs that Stable-Baselines3 and `torchrun` make at every start, and leave.
    """
    variables = {key: value for key, value in os.environ.items() if key not in ("VIRTUAL_ENV", "PYTHONPATH")}
    variables["CARAWARE_RUNTIME_DIR"] = str(directory / ".registry")
    variables["SB3_LOGDIR"] = variables["PET_LOG_DIR"] = str(directory / ".logs")
    directories = variables["PATH"].split(os.pathsep)
    variables["PATH"] = os.pathsep.join(name for name in directories if not (Path(name) / "caraware").exists())
    return variables


def faults(block: Block, page: Path) -> list[str]:
    """What is wrong with a block that does not run, as far as its text shows."""
    if block.elsewhere:
        test = ROOT / block.elsewhere
        if not test.exists() or page.name not in test.read_text():
            return [f"{block.elsewhere} does not read {page.name}"]
    for named in re.findall(r"[\w/]+/tests/[\w.]+|docs/[\w/-]+\.md", block.long_reason + block.skip_reason):
        if not (ROOT / named).exists():
            return [f"{named} does not exist"]
    if block.language == "python":
        try:
            compile(block.text.replace("…", "..."), str(page), "exec")
        except SyntaxError as error:
            return [f"line {block.line + (error.lineno or 0)}: {error.msg}"]
        return []
    checked = subprocess.run(["bash", "-n", "-c", block.text], capture_output=True, text=True, check=False)
    if checked.returncode:
        return [checked.stderr]
    lines = block.text.replace("\\\n", " ").splitlines()
    return [f"{line}\n  {why}" for line in lines if (why := refusal(line)) is not None]


def refusal(line: str) -> str | None:
    """Why a command line cannot be right: what it names does not exist, or its arguments are refused."""
    words = shlex.split(line, comments=True)
    while words and re.match(r"[A-Z_]+=", words[0]):
        words.pop(0)
    match words:
        case ["caraware-viewer", "command", *arguments]:
            return refused_by("caraware_viewer.command", arguments)
        case ["caraware-viewer", *arguments]:
            return refused_by("caraware_viewer.__main__", [word for word in arguments if word != "&"])
        case ["caraware", "reproduce", *arguments]:
            return refused_by("caraware.study.reproduce", arguments)
        case ["caraware", "study", *arguments]:
            return refused_by("caraware.trials.study", arguments)
        case ["caraware", "report", *arguments]:
            return refused_by("caraware.report.document", arguments)
        case ["caraware", "bench", *arguments]:
            # Every argument before `--help` is parsed.
            command = [str(ROOT / ".venv" / "bin" / "caraware"), "bench", *arguments, "--help"]
            parsed = subprocess.run(command, capture_output=True, text=True, check=False)
            return parsed.stderr if parsed.returncode else None
        case ["make", *targets]:
            known = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
            unknown = [word for word in targets if "=" not in word and word not in known]
            return f"the Makefile has no target {unknown[0]}" if unknown else None
        case ["python" | ".venv/bin/python" | "torchrun" | "cargo", *arguments]:
            return missing(arguments)
    return None


def missing(arguments: list[str]) -> str | None:
    """The module, example, test or script that a command line names and that does not exist."""
    for option, word in pairwise(arguments):
        if option == "-m" and find_spec(word) is None:
            return f"there is no module {word}"
        if option in ("--example", "--test") and not any(ROOT.glob(f"*/{option[2:]}s/{word}*")):
            return f"there is no {option[2:]} {word}"
    scripts = [word for word in arguments[:1] if word.endswith(".py") and not (ROOT / word).exists()]
    return f"{scripts[0]} does not exist" if scripts else None


def refused_by(module: str, arguments: list[str]) -> str | None:
    """What the parser of a Python module has against arguments."""
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            import_module(module).parser().parse_args(arguments)
    except SystemExit:
        return said.getvalue()
    return None


@dataclass
class PageResult:
    """What came of a page."""

    states: Counter[str]
    failures: int
    seconds: float


def run_page(page: Path, with_long: bool, lists: bool) -> PageResult:
    """Run or parse the blocks of a page, and print a line for each."""
    result, begin = PageResult(Counter(), 0, 0.0), time.monotonic()
    name = page.relative_to(ROOT) if page.is_relative_to(ROOT) else page
    blocks = blocks_of(page)
    is_active = not any("bin/activate" in block.text for block in blocks)
    limit_s = LONG_BLOCK_LIMIT_S if with_long else BLOCK_LIMIT_S
    with tempfile.TemporaryDirectory(prefix="newcomer-") as directory:
        shell = Shell(Path(directory), is_active, limit_s)
        for block in blocks:
            if not block.is_code:
                if block.file_name is not None and not lists:
                    shell.run(block)
                continue
            state = block.state(with_long)
            result.states[state] += 1
            why = block.skip_reason or block.elsewhere or block.long_reason or ", ".join(SKIPPED_COMMANDS)
            if state != "run":
                print(f"{state:18} {name}:{block.line}{'' if state == 'outline' else f': {why}'}")
            elif lists:
                print(f"{state:18} {name}:{block.line}")
            if state != "run" or block.left_out:
                for fault in faults(block, page):
                    print(f"FAILED             {name}:{block.line}: {fault}")
                    result.failures += 1
            if state != "run" or lists:
                continue
            started = time.monotonic()
            is_good, output = shell.run(block)
            ended = "background" if block.is_background else "ok" if is_good else "FAILED"
            print(f"{ended:10} {time.monotonic() - started:6.1f} s {name}:{block.line}", flush=True)
            if "--show" in sys.argv or not is_good:
                print(output)
            if not is_good:
                result.failures += 1
                break
        for output in shell.close():
            print(f"FAILED in the background, {name}:\n{output}")
            result.failures += 1
    result.seconds = time.monotonic() - begin
    return result


def pages() -> Iterator[Path]:
    """README, docs, tutorials and the page of the configuration."""
    yield ROOT / "README.md"
    yield from sorted((ROOT / "docs" / "tutorials").glob("*.md"))
    yield from sorted((ROOT / "docs").glob("*.md"))
    yield ROOT / "configs" / "README.md"


def main() -> int:
    """Run the pages that the command line names, or all."""
    options = {word for word in sys.argv[1:] if word.startswith("--")}
    if unknown := options - {"--all", "--list", "--show"}:
        print(f"unknown: {', '.join(sorted(unknown))}; --all, --list and --show are known", file=sys.stderr)
        return 2
    named = [Path(word).resolve() for word in sys.argv[1:] if not word.startswith("--")] or list(pages())
    results = [run_page(page, "--all" in options, "--list" in options) for page in named]
    failures, seconds = sum(result.failures for result in results), sum(result.seconds for result in results)
    states = sum((result.states for result in results), Counter[str]())
    counted = ", ".join(f"{count} {state}" for state, count in states.most_common())
    print(f"{len(named)} pages in {seconds:.0f} s: {counted or 'no block'}; {failures} failures")
    return 1 if failures else 0


if __name__ == "__main__":
    # The parsers of the project's own modules are in its environment.
    if Path(sys.prefix) != PYTHON.parent.parent and PYTHON.exists():
        os.execv(PYTHON, [str(PYTHON), *sys.argv])
    sys.exit(main())
