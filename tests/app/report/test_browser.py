"""The report in a browser: nothing fails, sliders and curves work, it fits a narrow screen."""

import json
import re
import shutil
import subprocess
from html import unescape
from pathlib import Path

import numpy as np
import pytest

from clra.app.report.comparison import Comparison, MatchedView, Pair
from clra.app.report.html_report import render
from clra.app.report.summary import Errors, Findings, angles_of
from clra.app.scan_description import Facts

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "chrome"))), None)

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="chromium is not installed")

# What goes wrong is kept, as are a person's doings and what became of them.
FIRST = """<script>
window.wrong = [];
addEventListener("error", event => wrong.push(String(event.message)));
console.error = (...texts) => wrong.push(texts.join(" "));
</script>"""
LAST = """<script>
addEventListener("load", () => {
  const send = (box, type, x, buttons) => {
    const frame = box.getBoundingClientRect();
    box.dispatchEvent(new PointerEvent(type, {clientX: frame.left + x * frame.width,
      clientY: frame.top + 20, buttons, bubbles: true}));
  };
  const found = {wide: document.documentElement.scrollWidth, window: innerWidth};
  const stage = document.querySelector(".stage"), split = document.querySelector(".split");
  split.value = 25;
  split.dispatchEvent(new Event("input"));
  found.split = stage.style.getPropertyValue("--split");
  send(stage, "pointerdown", 0.7, 1);
  found.dragged = [stage.style.getPropertyValue("--split"), split.value];
  found.clip = getComputedStyle(stage.querySelector(".before")).clipPath;
  const box = document.querySelector(".slice").closest(".viewer");
  const slice = box.querySelector(".slice"), seen = [];
  for (const k of [0, Number(slice.max)]) {
    slice.value = k;
    slice.dispatchEvent(new Event("input"));
    seen.push([box.querySelector("output").textContent, box.querySelector(".after").src]);
  }
  found.places = seen.map(one => one[0]);
  found.changed = seen[0][1] !== seen[1][1];
  const chart = document.querySelector(".chart"), canvas = chart.querySelector("canvas");
  const whole = canvas.toDataURL();
  found.inked = new Set(canvas.getContext("2d").getImageData(
    0, 0, canvas.width, canvas.height).data).size > 10;
  send(canvas, "pointerdown", 0.3, 1);
  send(canvas, "pointermove", 0.5, 1);
  send(canvas, "pointerup", 0.5, 0);
  const zoomed = canvas.toDataURL();
  found.read = chart.querySelector("output").textContent;
  chart.querySelector(".reset").click();
  const back = canvas.toDataURL();
  chart.querySelector("[data-axis=angle]").click();
  found.zoomed = [zoomed !== whole, back === whole, canvas.toDataURL() !== whole];
  found.wrong = wrong;
  document.body.dataset.found = JSON.stringify(found);
});
</script>"""


def chromium(page: Path, width: int, *options: str) -> str:
    command = [
        str(CHROMIUM),
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        "--hide-scrollbars",
        # Every host is refused: the page has to do without.
        "--host-resolver-rules=MAP * ~NOTFOUND",
        f"--user-data-dir={page.parent / 'profile'}",
        f"--window-size={width},900",
        "--virtual-time-budget=5000",
        *options,
        page.as_uri(),
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=120)
    return done.stdout + done.stderr


@pytest.fixture(scope="module")
def page(record, scan) -> str:
    random = np.random.default_rng(1)

    def pair(*shape: int) -> Pair:
        image = random.random(shape).astype(np.float32)
        return Pair(image, 2 * image)

    measured = pair(41, 33)
    match = MatchedView(11, "farthest moved", measured.before, measured.after, pair(41, 33))
    slices = tuple((0.1 * k, pair(60, 60)) for k in range(-3, 4))
    comparison = Comparison(
        pair(400, 400), pair(300, 400), pair(80, 80), 0.005, "a method", (match,), 0.01, slices
    )
    errors = Errors.of(record, scan)
    facts = Facts.of(scan).lines()
    return render(Findings(record, errors, comparison, facts, angles=angles_of(scan)))


@pytest.mark.parametrize("width", [1280, 390])
def test_a_person_can_work_with_the_page(page, tmp_path, width):
    path = tmp_path / "report.html"
    path.write_text(page.replace("<head>", "<head>" + FIRST).replace("</body>", LAST + "</body>"))
    # Headless windows are 500 pixels wide at least: a frame is not.
    frame = tmp_path / "frame.html"
    frame.write_text(
        f'<iframe src="report.html" style="width:{width}px;height:900px;border:0"></iframe>'
        "<script>addEventListener('load', () => setTimeout(() => { document.body.dataset.found = "
        "document.querySelector('iframe').contentDocument.body.dataset.found; }, 1000));</script>"
    )
    shown = chromium(frame, max(width, 500) + 40, "--dump-dom", "--allow-file-access-from-files")
    told = re.search(r'data-found="([^"]*)"', shown)
    assert told, shown[:2000]
    found = json.loads(unescape(told[1]))
    assert found["wrong"] == []
    assert found["window"] == width and found["wide"] <= width
    assert found["split"] == "25%"
    assert found["dragged"] == ["70%", "70"] and "30%" in found["clip"]
    assert found["places"] == ["z = -0.3 mm", "z = +0.3 mm"] and found["changed"]
    assert found["inked"] and found["zoomed"] == [True, True, True]
    assert re.match(r"view \d+: u \(columns\) ", found["read"])


def test_it_is_small(page):
    assert len(page.encode()) < 5e6


def test_console_is_quiet(page, tmp_path):
    path = tmp_path / "report.html"
    path.write_text(page)
    picture = tmp_path / "shot.png"
    command = ("--enable-logging=stderr", f"--screenshot={picture}")
    assert "CONSOLE" not in chromium(path, 1280, *command)
    assert picture.stat().st_size > 10_000
