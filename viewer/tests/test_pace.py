"""A page reports how long a frame takes it, and the viewer sends no more than that page can draw."""

from __future__ import annotations

import http.client
import time
from urllib.parse import urlsplit

import pytest
from browser import Browser
from ports import free_port

from caraware_viewer.display import Display
from caraware_viewer.page import JOINING_S, Pace
from caraware_viewer.watch import FrameRate


def test_the_slowest_page_counts_until_it_is_closed() -> None:
    now_s = 0.0
    pace = Pace(lambda: now_s)
    assert pace.frame_s() == 0.0
    pace.report(0.4)
    pace.report(0.05)
    assert pace.frame_s() == 0.4
    now_s = 11.0
    pace.report(0.05)
    assert pace.frame_s() == 0.05


@pytest.mark.parametrize(
    ("most_hz", "frame_s", "interval_s"), [(10, 0.03, 0.1), (10, 0.3, 0.6), (2, 0.1, 0.5), (10, 60, 5)]
)
def test_a_slow_page_gets_fewer_ticks(most_hz: float, frame_s: float, interval_s: float) -> None:
    pace = Pace()
    pace.report(frame_s)
    assert FrameRate(most_hz, pace, keeps=False).interval_s() == pytest.approx(interval_s)


def test_without_an_open_page_few_ticks_are_drawn_unless_a_file_keeps_them() -> None:
    assert FrameRate(10, Pace(), keeps=False).interval_s() == 5.0
    assert FrameRate(10, Pace(), keeps=True).interval_s() == pytest.approx(0.1)
    assert FrameRate(10, None, keeps=False).interval_s() == pytest.approx(0.1)


def test_a_browser_reports_its_pace_and_other_sites_do_not() -> None:
    with Display.web(free_port()) as display, Browser(400, 300) as browser:
        assert display.page is not None
        pace, deadline = display.page.pace, time.monotonic() + 300
        browser.open(f"{display.page.url}?renderer=webgl")
        while not any(frame_s != JOINING_S for _, frame_s in list(pace._reports)):
            assert time.monotonic() < deadline, "the page reports nothing"
            browser.evaluate("0")
        assert 0.0 < pace.frame_s() < 300.0
        answers = []
        for body, site in ((b"0.123", "cross-site"), (b"0.123", "same-origin"), (b"1e3", "same-origin"), (b"", "none")):
            connection = http.client.HTTPConnection(str(urlsplit(display.page.url).netloc), timeout=60)
            connection.request("POST", "/pace", body, {"Sec-Fetch-Site": site})
            answers.append(connection.getresponse().status)
        assert answers == [404, 204, 404, 404]
