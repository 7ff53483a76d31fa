import base64
import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest

from clra.app.report.comparison import Comparison, MatchedView, Pair
from clra.app.report.html_report import render, write_report
from clra.app.report.page import embedded
from clra.app.report.summary import Errors, Findings, summary_of
from clra.app.scan_description import Facts
from clra.findings import Finding
from clra.methods.alignment.result import AlignmentResult
from clra.methods.alignment.rigid.rigid_parts import rigid_parts
from clra.methods.assessment.agreement import Agreement
from clra.methods.assessment.quality import Quality
from clra.model.motion import Motion
from clra.model.rigid.rigid_motion import RigidMotion
from clra.model.trajectory import circular


class Checker(HTMLParser):
    """Counts figures and captions and refuses what a browser would fetch or run."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.images: list[dict[str, str]] = []
        self.captions = 0

    def handle_starttag(self, tag, attrs):
        values = dict(attrs)
        assert tag not in ("link", "iframe")
        assert tag != "script" or "src" not in values
        assert not any(v and v.startswith(("http:", "https:", "//")) for v in values.values())
        if tag == "img":
            self.images.append(values)
        self.captions += tag == "figcaption"
        if tag not in ("img", "meta", "br", "input"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


_QUALITY = Agreement(2, 0.514, 0.137, 0.083, 0.041, 1.75)


@pytest.fixture(scope="module")
def comparison() -> Comparison:
    random = np.random.default_rng(1)

    def pair(*shape: int) -> Pair:
        image = random.random(shape).astype(np.float32)
        return Pair(image, 2 * image)

    measured = pair(41, 33)
    match = MatchedView(11, "farthest moved", measured.before, measured.after, pair(41, 33))
    return Comparison(pair(33, 33), pair(40, 33), pair(8, 8), 0.005, "a method", (match,), 0.01)


@pytest.fixture(scope="module")
def page(record, scan, comparison) -> str:
    errors = Errors.of(record, scan)
    return render(Findings(record, errors, comparison, Facts.of(scan).lines(), _QUALITY))


def test_the_page_is_well_formed_and_needs_nothing_else(page):
    checker = Checker()
    checker.feed(page)
    assert checker.open == []
    # Before and after of three slices, four pictures of a view, the convergence; three charts.
    assert (len(checker.images), checker.captions) == (11, 8)
    for image in checker.images:
        kind, data = re.fullmatch(r"data:image/(.+);base64,(.+)", image["src"]).groups()
        content = base64.b64decode(data, validate=True)
        assert content.startswith({"png": b"\x89PNG", "jpeg": b"\xff\xd8"}.get(kind, b"<?xml"))
        assert image["alt"]


def test_the_page_tells_all_there_is(page, record):
    for part in (
        "Alignment of tiny",
        '<div class="told warning"><div class="what">few features</div></div>',
        '<div class="told warning"><div class="what">3 &lt; 4 views</div></div>',
        "No verdict",
        "Correction of each radiograph",
        "the inverse of the estimated motion",
        "Convergence",
        "Error of each view",
        "Before and after",
        "reconstructed by a method",
        "re-projections",
        "translation x",
        "Flagged views: 3, 17",
        "gauge-free, without flagged views",
        "2 of 24 views flagged",
        "1QR-1HR",
        "a device",
        record.checksum,
        "space-filling",
        "4.00 times",  # doubled pictures have four times the squared gradient
        "clra 0.",
    ):
        assert part in page, part


def test_the_page_says_what_the_radiographs_alone_tell(page):
    section = page.partition("What the radiographs alone tell")[2].partition("</section>")[0]
    for number in ("51.4 %", "13.7 %", "0.083, 0.041", "1.75", "binned by 2"):
        assert number in section


@pytest.mark.parametrize("verdict", ["good", "doubtful", "failed"])
def test_the_verdict_and_its_reasons_come_first(record, verdict):
    reason = Finding("held-out-shift", "views lie beside", "more iterations may help")
    quality = Quality(
        verdict, (reason,) if verdict != "good" else (), shift_after=(0.1, 0.2, 0), error=0.25
    )
    page = render(Findings(replace(record, quality=quality)))
    body = page.partition("</header>")[2]
    assert body.lstrip().startswith(f'<div class="told {verdict} verdict">')
    first = body.partition('<div class="card')[0]
    assert ("<li>views lie beside: more iterations may help</li>" in first) == (verdict != "good")
    assert "0.10, 0.20" in first and "0.25" in first


def test_what_is_embedded_cannot_end_its_element():
    assert "</script" not in embedded({"x": "</script><b>"}).removesuffix("</script>")


def test_text_from_files_is_escaped(page):
    assert "clra align &lt;scan&gt;.nxs" in page
    assert "<scan>" not in page


def test_the_same_report_twice_is_the_same_page(page, record, scan, comparison):
    errors = Errors.of(record, scan)
    again = Findings(record, errors, comparison, Facts.of(scan).lines(), _QUALITY)
    assert render(again) == page


def test_a_motion_alone_makes_a_page(tmp_path):
    bare = AlignmentResult.from_motion(Motion.identity(5))
    write_report(tmp_path / "r.html", Findings(bare))
    page = (tmp_path / "r.html").read_text(encoding="utf-8")
    assert "--scan SCAN" in page and "Convergence" not in page and "told warning" not in page
    assert [file.name for file in tmp_path.iterdir()] == ["r.html"]


def test_errors_are_those_of_the_estimate(record, scan):
    errors = Errors.of(record, scan)
    truth = scan.truth
    expected = np.abs(record.motion.shift_u - truth.shift_u).mean()
    means = errors.means()
    assert means["mae_u"] == pytest.approx(expected)
    assert 0 < means["gauge_free_mae_u"] < 1.2 * expected
    _, text = summary_of(record, errors)
    assert "1QR-1HR" in text and f"{expected:.3f}" in text


def test_a_rigid_motion_has_its_six_curves_and_numbers():
    geometry = circular(
        8, source_to_axis=40.0, source_to_detector=100.0, pixel_size=0.2, shape=(31, 45)
    )
    table = np.zeros((8, 6))
    table[:, 0], table[:, 4] = 0.3, np.radians(0.5)
    motion = RigidMotion.of(geometry, table)
    sigma = np.tile([0.1, 0.1, 1e-3, *np.radians([0.2] * 3)], (8, 1))
    result = replace(AlignmentResult.from_motion(motion), sigma=sigma)
    parts = rigid_parts(result)
    # 0.3 mm at 40 of 100 mm are 0.75 mm, 3.75 pixels; 0.1 pixel is 8 um there.
    assert parts["along u [\u00b5m]"] == pytest.approx((300, 300, 8))
    assert parts["along u [pixel]"] == pytest.approx((3.75, 3.75, 0.1))
    assert parts["along the beam [\u00b5m]"] == pytest.approx((0, 0, 40))
    assert parts["about v [degree]"] == pytest.approx((0.5, 0.5, 0.2))
    page = render(Findings(result))
    assert "Motion of the sample" in page and "about v [degree]" in page
    assert "80 \u00b5m of the sample" in page
    values, text = summary_of(result, None)
    assert values["rigid"]["about v [degree]"]["rms"] == pytest.approx(0.5)
    assert "0.000, 0.500, 0.000 degrees rms" in text


@pytest.mark.filterwarnings("default")
def test_the_page_is_shown_where_there_is_a_browser(clra, motion_file, tmp_path, monkeypatch):
    page, shown = tmp_path / "r.html", []
    for there in (True, False):
        monkeypatch.setattr("webbrowser.open", lambda url, t=there: shown.append(url) or t)
        status, _, error = clra("report", motion_file, "-o", page, "--open", "-q")
        assert status == 0 and ("found no browser here" in error) == (not there)
    assert shown == 2 * [page.as_uri()]
