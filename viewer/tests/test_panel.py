"""`caraware panel`: its actions in a real browser against a live run, its guards, and what it leaves behind.

`CARAWARE_PANEL_SCREENSHOT=docs/images/panel.png pytest viewer/tests/test_panel.py` makes the picture of docs/panel.md.
"""

from __future__ import annotations

import contextlib
import http.client
import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import psutil  # type: ignore[import-untyped]  # the package has no types
import pytest
from browser import Browser
from PIL import Image
from ports import free_port

ROOT = Path(__file__).parents[2]
COMMAND = ROOT / "target" / "release" / "caraware"
PICTURE = os.environ.get("CARAWARE_PANEL_SCREENSHOT")
SIZE = (1500, 1150)
PATIENCE_S = 300.0
"""Longest wait for one condition, for a machine whose cores are busy with other work."""
LEAST_ACTIONS = 30

CURRICULUM = "[{cavs = 6, ticks = 30, until_lessons = 1}, {cavs = 8}]"
FIELDS = {
    "run.real_time_factor": "2",
    "traffic.cavs": "8",
    "traffic.others": "4",
    "episode.ticks": "5000",
    "trainer.horizon": "256",
    "trainer.batch_size": "128",
    "curriculum.stages": CURRICULUM,
}
"""What the form changes: a paced run, so that an episode lasts for all actions, whose learner updates after seconds."""


@dataclass(frozen=True)
class RunningPanel:
    """A panel as a process."""

    process: subprocess.Popen[bytes]
    port: int
    key: str
    directory: Path
    environment: dict[str, str]

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}/#{self.key}"

    def request(
        self, method: str, path: str, document: object = None, **changed: str | None
    ) -> tuple[int, dict[str, Any]]:
        """Status and document of an answer. `changed` are headers, with `_` for `-`; `None` leaves one out."""
        headers = {"Host": f"127.0.0.1:{self.port}", "Authorization": f"Bearer {self.key}"}
        headers |= {"Content-Type": "application/json"}
        given = headers | {name.replace("_", "-"): value for name, value in changed.items()}
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=PATIENCE_S)
        body = None if document is None else json.dumps(document)
        connection.request(method, path, body, {name: value for name, value in given.items() if value is not None})
        answer = connection.getresponse()
        text = answer.read()
        connection.close()
        is_json = answer.getheader("Content-Type", "").startswith("application/json")
        return answer.status, json.loads(text) if is_json else {"text": text.decode()}

    def run(self, *arguments: str) -> dict[str, Any]:
        """Starts a command, and waits for its end."""
        status, command = self.request("POST", "/api/commands", {"arguments": list(arguments)})
        assert status == 201, command
        deadline = time.monotonic() + PATIENCE_S
        while command["exit_code"] is None:
            assert time.monotonic() < deadline, command
            time.sleep(0.1)
            _, command = self.request("GET", f"/api/commands/{command['id']}")
        return command

    def caraware(self, *arguments: str) -> str:
        """Output of the same command in a terminal."""
        words = [str(COMMAND), *arguments]
        ended = subprocess.run(
            words, cwd=self.directory, env=self.environment, capture_output=True, text=True, timeout=PATIENCE_S
        )
        assert ended.returncode == 0, ended.stderr
        return ended.stdout

    def no_run_is_alive(self) -> bool:
        """True if `caraware ps` lists none; it fails while a run is about to end."""
        listed = subprocess.run([str(COMMAND), "ps"], env=self.environment, capture_output=True, timeout=PATIENCE_S)
        return listed.stdout == b"no run is alive\n"


@contextlib.contextmanager
def panel_in(directory: Path) -> Iterator[RunningPanel]:
    """A panel in a directory of its own."""
    assert COMMAND.exists(), "run `make build` first"
    environment = os.environ | {
        "CARAWARE_RUNTIME_DIR": f"/tmp/caraware-p{os.getpid()}",
        "CARAWARE_PYTHON": sys.executable,
    }
    port = free_port()
    log = directory / "panel.log"
    with log.open("wb") as output:
        process = subprocess.Popen(
            [str(COMMAND), "panel", "--port", str(port)], cwd=directory, env=environment, stdout=output, stderr=output
        )
    try:
        wait_until(lambda: "open http" in log.read_text() or process.poll() is not None, "the panel does not start")
        found = re.search(r"open http://127\.0\.0\.1:(\d+)/#(\S+) ", log.read_text())
        assert found is not None, log.read_text()
        yield RunningPanel(process, int(found[1]), found[2], directory, environment)
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
            process.wait(PATIENCE_S)


def wait_until(condition: Any, what: str) -> None:
    """Waits until a condition is true."""
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline, what
        time.sleep(0.1)


class PanelPage:
    """The page in a browser, as a person uses it."""

    def __init__(self, browser: Browser) -> None:
        self.browser = browser
        self.actions: list[str] = []

    def did(self, action: str) -> None:
        """Notes an action that has worked."""
        self.actions.append(action)

    def wait(self, expression: str) -> None:
        """Waits for a condition; on failure reports what the page shows."""
        try:
            self.browser.wait_for(f"Boolean({expression})", PATIENCE_S)
        except TimeoutError as error:
            shown = self.browser.evaluate("document.querySelector('#right').innerText")
            raise AssertionError(f"{error} after {self.actions}\n{shown}") from error

    def text(self, selector: str) -> str:
        return str(self.browser.evaluate(f"document.querySelector({selector!r}).textContent"))

    def click_at(self, x: float, y: float) -> None:
        """Moves the mouse to a place of the window, and clicks."""
        for kind in ("mouseMoved", "mousePressed", "mouseReleased"):
            pressed: dict[str, Any] = {} if kind == "mouseMoved" else {"button": "left", "clickCount": 1}
            self.browser.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, **pressed)

    def click(self, element: str) -> None:
        """Clicks on an element, given by a selector or by an expression in brackets, once it can be clicked."""
        found = element if element.startswith("(") else f"document.querySelector({element!r})"
        # The rectangle is measured after the element is at rest in the middle of the window, and on top there.
        place = (
            f"(() => {{ const e = {found}; if (!e || e.disabled || e.offsetParent === null) return null;"
            "e.scrollIntoView({block: 'center'}); const b = e.getBoundingClientRect();"
            "const at = [b.x + b.width / 2, b.y + b.height / 2];"
            "const top = document.elementFromPoint(...at);"
            "return top && (top === e || e.contains(top)) ? at : null; })()"
        )
        # The page may move it between the look and the click, which then hits something else: such a click is repeated.
        hit = (
            "window.hit = null; document.addEventListener('click', (event) => {"
            f"window.hit = event.composedPath().includes({found}); }}, {{once: true, capture: true}}); true"
        )
        deadline = time.monotonic() + PATIENCE_S
        while True:
            self.wait(f"{place} !== null")
            self.browser.evaluate(f"(() => {{ {hit} }})()")
            if (at := self.browser.evaluate(place)) is not None:
                self.click_at(*at)
                if self.browser.evaluate("window.hit") is True:
                    return
            assert time.monotonic() < deadline, f"no click hits {element}"

    def click_text(self, scope: str, text: str) -> None:
        """Clicks on the button with this text."""
        buttons = f"[...document.querySelectorAll({scope + ' button'!r})]"
        self.click(f"({buttons}.find((one) => one.textContent === {text!r}))")

    def type(self, selector: str, text: str) -> None:
        """Replaces the text of a field by the keyboard."""
        self.browser.evaluate(
            f"(() => {{ const e = document.querySelector({selector!r}); e.closest('details')?.setAttribute('open', '');"
            "e.scrollIntoView({block: 'center'}); e.focus(); e.select(); })()"
        )
        self.browser.call("Input.insertText", text=text)
        self.wait(f"document.querySelector({selector!r}).value === {text!r}")

    def choose(self, selector: str, value: str) -> None:
        """Chooses an option."""
        options = f"[...document.querySelector({selector!r}).options].some((one) => one.value === {value!r})"
        self.wait(options)
        self.browser.evaluate(
            f"(() => {{ const e = document.querySelector({selector!r}); e.value = {value!r};"
            "for (const kind of ['input', 'change']) e.dispatchEvent(new Event(kind, {bubbles: true})); })()"
        )

    def newest(self) -> str:
        """Expression: the newest command in the list."""
        return "document.querySelector('#commands li')"

    def wait_for_command(self, line: str, status: str = "done") -> None:
        """Waits until the newest command is this one and has this state."""
        self.wait(
            f"{self.newest()}?.querySelector('code').textContent.startsWith({'$ ' + line!r}) && "
            f"{self.newest()}.querySelector('.status').textContent.startsWith({status!r})"
        )

    def wait_for_run(self, name: str, state: str) -> None:
        """Waits until the list shows a run in a state."""
        row = f"document.querySelector('#runs tr[data-run={name}]')"
        self.wait(f"{row}?.cells[3].textContent.startsWith({state!r})")

    def map_point(self, expression: str) -> tuple[float, float]:
        """Place in the window of a place on the map, an expression for `[x, y]` in metres."""
        self.browser.evaluate("document.querySelector('#map').scrollIntoView({block: 'center'})")
        x, y = self.browser.evaluate(
            f"(() => {{ const c = document.querySelector('#map'), b = c.getBoundingClientRect();"
            f"const [x, y] = window.panelMap.toCanvas(...{expression});"
            "return [b.left + x * b.width / c.width, b.top + y * b.height / c.height]; })()"
        )
        return float(x), float(y)

    def tick(self) -> int:
        """Tick of `sensor-daemon` in the process table."""
        return int(
            self.browser.evaluate("document.querySelector('tr[data-process=sensor-daemon]').cells[3].textContent")
        )


def test_thirty_actions_in_a_browser_steer_a_live_run(tmp_path: Path) -> None:
    with panel_in(tmp_path) as panel, Browser(*SIZE) as browser:
        page = PanelPage(browser)
        browser.open(panel.url)
        page.wait("document.body.dataset.ready === 'true'")
        page.did("open the page")
        fill_form(page)
        page.click("#start-button")
        page.wait_for_run("first", "alive")
        page.did("start")
        steer(page)
        swap_and_watch(page)
        make_picture(page)
        mistakes(page)
        end_and_compare(page)
        check_listeners(panel)
        hosts = {urlsplit(address).hostname for address in browser.requests}
        started = psutil.Process(panel.process.pid).children(recursive=True)
        assert started, "the played run is alive"
        panel.process.send_signal(signal.SIGINT)
        assert panel.process.wait(PATIENCE_S) == 130, (tmp_path / "panel.log").read_text()
        page.wait("document.querySelector('#connection').textContent.includes('does not answer')")
        page.did("Ctrl-C ends the panel")
    assert [child for child in started if child.is_running() and child.status() != psutil.STATUS_ZOMBIE] == []
    assert panel.no_run_is_alive()
    assert hosts <= {"127.0.0.1", None}, "the page sent requests to other hosts"
    assert len(page.actions) >= LEAST_ACTIONS, page.actions


def test_vehicles_of_each_environment_are_shown_and_steered(tmp_path: Path) -> None:
    line = "caraware train town --envs 2 --name two --set traffic.cavs=4 --set traffic.others=0"
    line += " --set run.real_time_factor=2 --set episode.ticks=5000"
    with panel_in(tmp_path) as panel, Browser(*SIZE) as browser:
        page = PanelPage(browser)
        browser.open(panel.url)
        page.wait("document.body.dataset.ready === 'true'")
        page.type("#own-line", f"{line} --set fanout.listen=tcp/127.0.0.1:{free_port()}")
        page.click("#own button")
        page.wait_for_run("two", "alive")
        choices = "[...document.querySelector('#environment').options].map((one) => one.value).join()"
        page.wait(f"{choices} === '0,1' && !document.querySelector('#environment-label').hidden")
        for environment in ("1", "0"):
            # Environments do not begin at the same moment.
            vehicles_of(page, environment)
            page.wait("window.panelMap.users().length > 0")
        page.click("#pause")
        page.wait_for_command("caraware control --run two pause")
        places = {environment: vehicles_of(page, environment) for environment in ("0", "1")}
        assert places["0"] != places["1"], "the map shows one environment twice"
        name = page.browser.evaluate("window.panelMap.users()[0].id")
        page.choose("#vehicle", name)
        page.choose("#sensor", "gnss")
        page.click("#sensor-off")
        page.wait_for_command(f"caraware control --run two --env 1 sensor {name} gnss off")
        page.click("#step")
        page.wait_for_command("caraware control --run two step 10")
        page.wait("!document.querySelector('#vehicle-state').textContent.includes('gnss')")
        vehicles_of(page, "0")
        page.choose("#vehicle", name)
        page.wait("document.querySelector('#vehicle-state').textContent.includes('gnss')")
    assert panel.no_run_is_alive()


def vehicles_of(page: PanelPage, environment: str) -> list[list[float]]:
    """Chooses an environment; returns the places of its vehicles, m."""
    page.choose("#environment", environment)
    page.wait(f"document.querySelector('#map').dataset.environment === '{environment}'")
    places: list[list[float]] = page.browser.evaluate("window.panelMap.users().map((user) => [user.x_m, user.y_m])")
    return places


def fill_form(page: PanelPage) -> None:
    page.choose("#start-preset", "driving")
    page.wait("document.querySelector('#start-purpose').textContent.startsWith('The driving task')")
    page.wait("document.getElementById('key-task.kind').value === 'driving'")
    page.did("choose a preset, whose values fill the form")
    page.choose("#start-preset", "town")
    page.wait("document.getElementById('key-task.kind').value === 'localisation'")
    page.type("#key-filter", "curriculum.stages")
    page.wait("document.querySelectorAll('.key:not([hidden])').length === 1")
    page.did("find a key")
    page.type("#key-filter", "")
    page.type("[id='key-traffic.cavs']", "-3")
    page.wait("document.querySelector('#start-button').disabled")
    assert page.text("#start-error") == "traffic.cavs allows 0 … 100000 vehicles"
    page.did("a value out of range is refused")
    for key, value in FIELDS.items():
        page.type(f"[id='key-{key}']", value)
    page.choose("[id='key-trainer.estimates']", "never")
    page.type("[id='key-fanout.listen']", f"tcp/127.0.0.1:{free_port()}")
    page.type("#start-name", "first")
    page.wait("!document.querySelector('#start-button').disabled")
    line = page.text("#start-line")
    assert line.startswith("caraware train town --set traffic.cavs=8 --set run.real_time_factor=2"), line
    assert line.endswith(" --name first") and f"--set 'curriculum.stages={CURRICULUM}'" in line, line
    page.did("the form shows its command")


def steer(page: PanelPage) -> None:
    """Processes, time, vehicles and sensors."""
    page.click_text("#tabs", "processes")
    for process in ("supervisor", "traffic-bridge", "sim-core", "sensor-daemon", "trainer", "fanout"):
        page.wait(f"document.querySelector('tr[data-process={process}]')?.cells[1].textContent === 'running'")
    page.did("the process table")
    page.click_text("#tabs", "curriculum")
    page.wait("document.querySelector('#curriculum tr.chosen')?.cells[0].textContent === '2'")
    assert "stage 2 of 2" in page.text("#curriculum")
    page.did("the curriculum reaches its second stage")
    page.click_text("#tabs", "control")
    page.wait("window.panelMap.users().filter((user) => user.kind === 'cav').length === 8")
    page.did("the map shows the vehicles")
    page.click("#pause")
    page.wait_for_command("caraware control --run first pause")
    page.click_text("#tabs", "processes")
    page.wait("document.querySelector('tr[data-process=traffic-bridge]').cells[4].textContent === '0'")
    page.wait("document.querySelector('tr[data-process=sensor-daemon]').cells[5].textContent === '0'")
    tick = page.tick()
    page.did("pause")
    page.click_text("#tabs", "control")
    page.type("#step-ticks", "10")
    page.click("#step")
    page.wait_for_command("caraware control --run first step 10")
    page.click_text("#tabs", "processes")
    page.wait(f"document.querySelector('tr[data-process=sensor-daemon]').cells[3].textContent === '{tick + 10}'")
    page.did("step")
    page.click_text("#tabs", "control")
    vehicle = "window.panelMap.users().filter((user) => user.kind === 'cav')[3]"
    name = page.browser.evaluate(f"{vehicle}.id")
    page.click_at(*page.map_point(f"[{vehicle}.x_m, {vehicle}.y_m]"))
    page.wait(f"document.querySelector('#vehicle').value === {name!r}")
    page.did("choose a vehicle by a click on the map")
    page.wait("document.querySelector('#vehicle-state').textContent.includes('gnss')")
    page.choose("#sensor", "gnss")
    page.click("#sensor-off")
    page.wait_for_command(f"caraware control --run first sensor {name} gnss off")
    page.click("#step")
    page.wait("!document.querySelector('#vehicle-state').textContent.includes('gnss')")
    page.did("switch a sensor off")
    page.click("#sensor-on")
    page.wait_for_command(f"caraware control --run first sensor {name} gnss on")
    page.click("#step")
    page.wait("document.querySelector('#vehicle-state').textContent.includes('gnss')")
    page.did("switch a sensor on")
    place(page, "start", name, 0)
    page.click("#step")
    page.wait(f"!document.querySelector('#vehicle').selectedOptions[0].textContent.startsWith({name!r})")
    page.did("place a start by a click on the map")
    place(page, "destination", page.browser.evaluate("document.querySelector('#vehicle').value"), 5)
    page.did("place a destination by a click on the map")
    page.click("input[name=place][value='']")
    page.click("#resume")
    page.wait_for_command("caraware control --run first resume")
    page.click_text("#tabs", "processes")
    page.wait(f"Number(document.querySelector('tr[data-process=sensor-daemon]').cells[3].textContent) > {tick + 60}")
    page.did("resume")


def place(page: PanelPage, what: str, vehicle: str, number: int) -> None:
    """Clicks in the middle of a road, with the chosen vehicle."""
    points = f"window.panelMap.map().lanes.filter((lane) => lane.kind === 'car' && !lane.inside)[{number}].points_m"
    middle = f"[({points}[0][0] + {points}[1][0]) / 2, ({points}[0][1] + {points}[1][1]) / 2]"
    page.click(f"input[name=place][value={what}]")
    edge = page.browser.evaluate(f"window.panelMap.nearestEdge(...{middle})")
    page.click_at(*page.map_point(middle))
    page.wait_for_command(f"caraware control --run first {what} {vehicle} {edge}")


def swap_and_watch(page: PanelPage) -> None:
    """Handover, logs, rerun's viewer."""
    page.click_text("#tabs", "control")
    page.choose("#handover-key", "trainer.learning_rate")
    page.type("#handover-value", "7")
    page.click("#handover")
    page.wait("document.querySelector('#banner-text').textContent.startsWith('trainer.learning_rate allows 0')")
    page.did("a handover with a wrong value is refused")
    page.click("#banner-close")
    page.type("#handover-value", "0.002")
    page.click("#handover-now")
    page.click("#handover")
    page.wait_for_command("caraware handover first --set trainer.learning_rate=0.002 --now")
    page.click_text("#tabs", "processes")
    page.wait("document.querySelector('tr[data-process=trainer]').cells[7].textContent === '1'")
    page.did("hand over to another trainer")
    page.click_text("#tabs", "logs")
    page.choose("#log-name", "trainer.log")
    # The log that the page showed before has such lines, too.
    page.wait(
        r"/^tail -n \d+ \S*runs\/first\/logs\/trainer.log$/.test(document.querySelector('#log-line').textContent)"
    )
    page.wait("document.querySelector('#log').textContent.includes(' INFO ')")
    page.did("read a log")
    page.click_text("#tabs", "view")
    page.click("#view-start")
    page.wait("document.querySelector('#view-frame iframe')")
    page.wait_for_command("caraware view first --web", "running")
    address = page.browser.evaluate("document.querySelector('#view-frame iframe').src")
    frames = "Page.getFrameTree"
    wait_until(
        lambda: any(
            frame["frame"]["url"].startswith(address) and "url=rerun" in frame["frame"]["url"]
            for frame in page.browser.call(frames)["frameTree"].get("childFrames", [])
        ),
        "the viewer's page is not embedded",
    )
    page.did("watch in rerun's viewer")
    page.click("#view-end")
    page.wait_for_command("caraware view first --web", "ended by Ctrl-C")
    page.wait("!document.querySelector('#view-frame iframe')")
    page.did("hide rerun's viewer")


def make_picture(page: PanelPage) -> None:
    if not PICTURE:
        return
    page.click_text("#tabs", "control")
    page.wait("window.panelMap.users().filter((user) => user.kind === 'cav').length === 8")
    page.browser.evaluate(
        "for (const section of document.querySelectorAll('#keys details'))"
        " section.open = section.firstChild.textContent.startsWith('traffic');"
        "document.querySelector('#keys').scrollTop = 0; window.scrollTo(0, 0)"
    )
    picture = Image.fromarray(page.browser.screenshot())
    picture.quantize(128, dither=Image.Dither.NONE).save(ROOT / PICTURE, optimize=True)


def mistakes(page: PanelPage) -> None:
    """Commands of one's own, right and wrong."""
    page.type("#own-line", "caraware ps first")
    page.click("#own button")
    page.wait_for_command("caraware ps first")
    page.wait(f"{page.newest()}.querySelector('pre').textContent.includes('sensor-daemon')")
    page.did("type a command")
    page.type("#own-line", "caraware stop nothing")
    page.click("#own button")
    page.wait_for_command("caraware stop nothing", "failed (2)")
    page.wait("document.querySelector('#banner-text').textContent.includes('no run named `nothing` is alive')")
    page.did("a command that fails is shown with its reason")
    page.click("#banner-close")
    page.wait("document.querySelector('#banner').hidden")
    page.type("#own-line", "caraware panel")
    page.click("#own button")
    page.wait("document.querySelector('#banner-text').textContent.includes('not `panel`')")
    page.did("a command that the panel does not run is refused")
    page.click("#banner-close")


def end_and_compare(page: PanelPage) -> None:
    """Stop, resume, a second run, comparison, play."""
    row = "#runs tr[data-run=first]"
    page.click_text(row, "stop")
    page.wait_for_command("caraware stop first")
    page.wait_for_run("first", "interrupted")
    page.did("stop")
    page.click_text(row, "resume")
    page.wait_for_command("caraware train --resume first", "running")
    page.wait_for_run("first", "alive")
    page.click_text("#tabs", "control")
    page.wait("window.panelMap.users().length > 0")
    page.did("resume a stopped run")
    items = "[...document.querySelectorAll('#commands li')]"
    train = f"{items}.find((one) => one.textContent.startsWith('$ caraware train --resume'))"
    page.click(f"({train}.querySelector('button'))")
    page.wait_for_run("first", "interrupted")
    page.wait(f"{train}.querySelector('.status').textContent === 'ended by Ctrl-C'")
    page.did("Ctrl-C for a command")
    page.click("#keys-reset")
    page.wait("document.querySelector('#start-line').textContent === 'caraware train town --name first'")
    page.did("reset the keys of the form")
    page.choose("#start-mode", "simulate")
    for key, value in {"run.real_time_factor": "2", "run.seed": "7"}.items():
        page.type(f"[id='key-{key}']", value)
    page.type("#start-name", "second")
    page.click("#start-button")
    page.wait_for_command("caraware simulate town --set run.real_time_factor=2", "running")
    page.wait_for_run("second", "alive")
    page.click_text("#tabs", "control")
    page.wait("document.querySelector('#run-title').textContent.startsWith('second')")
    page.wait("window.panelMap.users().length > 0")
    page.did("simulate without learning")
    page.click("#reset")
    page.wait_for_command("caraware control --run second reset")
    page.did("reset")
    page.click_text("#runs tr[data-run=second]", "stop")
    page.wait_for_command("caraware stop second")
    page.wait_for_run("second", "interrupted")
    for name in ("first", "second"):
        page.click(f"#runs tr[data-run={name}] input")
    page.click("#compare")
    page.wait_for_command("caraware compare first second")
    page.wait("document.querySelector('#comparison').textContent.includes('run.seed')")
    assert re.search(r"^run\.seed +1 +7$", page.text("#comparison"), re.MULTILINE), page.text("#comparison")
    page.did("compare runs")
    page.click_text(row, "play")
    page.wait_for_command("caraware play first", "running")
    page.wait("[...document.querySelectorAll('#runs tr')].some((one) => one.textContent.includes('playalive'))")
    page.did("play what a run has learnt")


def check_listeners(panel: RunningPanel) -> None:
    """Neither the panel nor what it has started listens beyond loopback."""
    processes = [psutil.Process(panel.process.pid)]
    processes += processes[0].children(recursive=True)
    listening = []
    for process in processes:
        with contextlib.suppress(psutil.NoSuchProcess):
            listening += [one.laddr for one in process.net_connections("inet") if one.status == psutil.CONN_LISTEN]
    assert panel.port in {address.port for address in listening}
    assert {address.ip for address in listening} <= {"127.0.0.1", "::1"}, listening


@pytest.fixture(scope="module")
def panel(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningPanel]:
    with panel_in(tmp_path_factory.mktemp("panel")) as running:
        yield running


def test_the_panel_answers_only_its_own_page_with_the_key(panel: RunningPanel) -> None:
    assert panel.request("GET", "/api/state")[0] == 200
    assert panel.request("GET", "/", Authorization=None)[0] == 200, "the page itself holds no secret"
    here = f"http://127.0.0.1:{panel.port}"
    assert panel.request("GET", "/api/state", Origin=here, Sec_Fetch_Site="same-origin")[0] == 200
    document = {"arguments": ["ps"]}
    refused: list[tuple[int, dict[str, str | None]]] = [
        (401, {"Authorization": None}),
        (401, {"Authorization": "Bearer " + panel.key[:-1]}),
        (401, {"Authorization": "Basic " + panel.key}),
        (403, {"Host": f"attacker.example:{panel.port}"}),
        (403, {"Host": "127.0.0.1:1"}),
        (403, {"Origin": "http://attacker.example"}),
        (403, {"Origin": "null"}),
        (403, {"Origin": f"http://127.0.0.1:{panel.port + 1}"}),
        (403, {"Sec_Fetch_Site": "cross-site"}),
    ]
    for status, headers in refused:
        for method, path, body in (("GET", "/api/state", None), ("POST", "/api/commands", document)):
            answer = panel.request(method, path, body, **headers)
            assert answer[0] == status and set(answer[1]) == {"error"}, (headers, answer)
    assert panel.request("GET", "/api/state")[1]["commands"] == [], "nothing was started"


def test_requests_that_make_no_sense_are_refused_with_a_reason(panel: RunningPanel) -> None:
    wrong: list[tuple[str, str, object, int]] = [
        ("POST", "/api/commands", {"arguments": ["bench", "all"]}, 400),
        ("POST", "/api/commands", {"arguments": []}, 400),
        ("POST", "/api/commands", {"arguments": "ps"}, 400),
        ("POST", "/api/commands", {"arguments": ["ps", 1]}, 400),
        ("POST", "/api/commands", ["ps"], 400),
        ("POST", "/api/commands", {"arguments": ["ps", "x" * 100_000]}, 413),
        ("GET", "/api/commands/77", None, 404),
        ("GET", "/api/run?run=..", None, 404),
        ("GET", "/api/run?run=%2Fetc", None, 404),
        ("GET", "/api/log?run=nothing&name=..%2Frun.json", None, 404),
        ("GET", "/api/users?run=nothing", None, 404),
        ("DELETE", "/api/state", None, 405),
    ]
    for method, path, document, status in wrong:
        answer = panel.request(method, path, document)
        assert answer[0] == status and answer[1]["error"], (path, answer)


def test_a_run_of_the_panel_is_that_of_the_terminal_and_ends_with_a_killed_panel(tmp_path: Path) -> None:
    words = ["simulate", "town", "--set", "episode.ticks=40", "--set", "episode.training_episodes=1"]
    words += ["--set", "fanout.enabled=false", "--quiet"]
    with panel_in(tmp_path) as panel:
        assert panel.run(*words, "--name", "panel")["exit_code"] == 0
        panel.caraware(*words, "--name", "terminal")
        hashes = {
            json.loads((tmp_path / "runs" / name / "report.json").read_text())["observation_hash"]
            for name in ("panel", "terminal")
        }
        assert len(hashes) == 1, hashes
        endless = ["simulate", "town", "--name", "endless", "--set", "run.real_time_factor=1"]
        assert panel.request("POST", "/api/commands", {"arguments": endless})[0] == 201
        wait_until(lambda: panel.request("GET", "/api/state")[1]["live"], "the run does not start")
        panel.process.kill()
        panel.process.wait()
        report = tmp_path / "runs" / "endless" / "report.json"
        wait_until(report.exists, "the run does not end with its panel")
        wait_until(panel.no_run_is_alive, "the run does not end with its panel")
        assert json.loads(report.read_text())["result"] == "interrupted"
