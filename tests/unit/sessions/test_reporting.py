"""A report stands by itself, says what was found, and lets nobody's text become markup."""

import re
import shutil
import subprocess
from dataclasses import replace
from datetime import UTC, datetime
from html import unescape
from html.parser import HTMLParser

import numpy as np
import pytest

from scanner_service.sessions.book import SessionBook
from scanner_service.sessions.replay_source import ReplaySource
from scanner_service.sessions.reporting import fates_of, report_of
from scanner_service.sessions.settings import SessionSettings
from scanner_service.sessions.source_specs import PushSpec
from scanner_service.sessions.stored import find_session, read_session
from scanner_service.storage.exports.report_content import FateRow, amount, flat_rows, shown
from scanner_service.storage.exports.report_html import report_html
from scanner_service.storage.exports.report_pdf import _set, report_pdf
from scanner_service.storage.reader import RecordReader
from scanner_service.storage.record import Record
from tests.unit.analysis.scans import surface_scan

NOW = datetime(2026, 11, 26, 9, 0, tzinfo=UTC)
NAME = '<script>alert("1")</script> & $x^2$ \u6f22'


@pytest.fixture(scope="module")
def stored(tmp_path_factory):
    """A plate with a gap of six lines, which a second pass fills."""
    rng = np.random.default_rng(1)
    coarse = surface_scan(lambda x, y: 0 * x, lines=40, points=70, spacing=0.4, rng=rng, noise_mm=0.002)
    coarse = [line for line in coarse if not 17 <= line.line_index < 23]
    fine = surface_scan(
        lambda x, y: 0 * x, lines=45, points=70, spacing=0.4, rng=rng, noise_mm=0.002, pass_index=1, boot_id=2
    )
    path = tmp_path_factory.mktemp("record") / "record.sqlite"
    with Record.open(path) as record:
        book = SessionBook(record)
        lines = coarse + fine
        session = book.create(
            NAME, PushSpec(), SessionSettings(max_points=20_000), source=ReplaySource(lines, len(lines))
        )
        session.start()
        assert session.wait_until_over(60)
        book.close()
    reader = RecordReader.open(path)
    yield read_session(reader, find_session(reader, "latest"), with_stages=True)
    reader.close()


@pytest.fixture(scope="module")
def content(stored):
    return report_of(stored, NOW)


class Elements(HTMLParser):
    """Every element with its attributes, and whether they were closed in order."""

    VOID = frozenset({"meta", "img", "br", "use", "path"})

    def __init__(self):
        super().__init__()
        self.seen, self.open = [], []

    def handle_starttag(self, tag, attrs):
        self.seen.append((tag, dict(attrs)))
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        if tag not in self.VOID:
            assert self.open.pop() == tag


def test_the_second_pass_is_told_to_have_filled_the_gap_of_the_first(content, stored):
    lost = [fate for fate in content.fates if fate.reason == "lost lines"]
    assert lost
    assert {fate.outcome for fate in lost} == {"resolved"}
    assert content.passes[0].coverage < content.passes[1].coverage
    assert [row.name for row in content.passes] == ["A pass 0", "A pass 1"]
    assert content.raw_sha256 == stored.raw_sha256


def test_what_is_as_bad_as_before_stays_open(stored):
    assert {fate.left_share for fate in fates_of(stored.first, stored.first)} == {1.0}
    assert [FateRow("A", "steep", 1.0, share).outcome for share in (0, 0.05, 0.2, 0.5, 1)] == [
        "resolved", "resolved", "partly resolved", "open", "open",
    ]  # fmt: skip


def test_the_html_needs_nothing_else_and_runs_nothing(content):
    html = report_html(content).decode("utf-8")
    elements = Elements()
    elements.feed(html)
    assert elements.open == []
    tags = {tag for tag, _ in elements.seen}
    assert tags.isdisjoint({"script", "iframe", "link", "object", "embed", "base", "form"})
    for tag, attributes in elements.seen:
        assert not any(name.startswith("on") for name in attributes), tag
        for name in ("src", "href", "xlink:href"):
            assert attributes.get(name, "data:").startswith(("data:", "#")), (tag, name)
    policy = next(a["content"] for t, a in elements.seen if a.get("http-equiv") == "Content-Security-Policy")
    assert policy.startswith("default-src 'none'")
    assert "@import" not in html
    assert "url(http" not in html
    assert NAME in unescape(re.sub(r"<(style|svg).*?</\1>", "", html, flags=re.DOTALL))


def text_of_pdf(pdf, tmp_path):
    if shutil.which("pdftotext") is None:
        pytest.skip("pdftotext (Debian: poppler-utils) is not installed")
    (tmp_path / "report.pdf").write_bytes(pdf)
    done = subprocess.run(["pdftotext", "-layout", tmp_path / "report.pdf", "-"], capture_output=True, check=True)
    return done.stdout.decode("utf-8")


def test_html_and_pdf_say_the_same_figures_with_their_thousands_apart(content, tmp_path):
    passes = [
        replace(row, lines=12345, touched_mm2=23456.7, gap_mm2=3456.78, region_mm2=4567.89) for row in content.passes
    ]
    content = replace(
        content,
        session_id="1ff2fi3fl4ffi",  # letters that fonts would draw as one, and readers would copy as none
        passes=tuple(passes),
        fates=tuple(replace(fate, area_mm2=5678.9) for fate in content.fates),
    )
    html = unescape(re.sub(r"<[^>]*>", " ", report_html(content).decode("utf-8")))
    pdf = text_of_pdf(report_pdf(content), tmp_path)
    wanted = [content.session_id, content.raw_sha256[:40], content.verdict_sha256[:40], content.software]
    wanted += [value for _, value in content.headlines]
    wanted += [amount(row.region_mm2, 1) for row in content.passes] + [fate.outcome for fate in content.fates]
    wanted += ["12 345", "23 457", "3 456.8", "5 678.9"]
    wanted += ["Losses", "Before and after", "Settings", "uncertainty", "0.1 mm", "5 °", "received"]
    assert not re.search(r"\d,\d{3}", re.sub(r"<(style|svg).*?</\1>", "", html, flags=re.DOTALL) + pdf)
    html, pdf = ("".join(text.split()) for text in (html, pdf))
    for text in wanted:
        assert "".join(text.split()) in html, text
        assert "".join(text.split()) in pdf, text


@pytest.fixture
def coarse(monkeypatch):
    """Pictures of few pixels, for tests that look at the pages only."""
    monkeypatch.setattr("scanner_service.storage.exports.report_pdf._PICTURE_DPI", 30)


@pytest.mark.usefixtures("coarse")
def test_no_page_is_spent_on_a_few_lines(content):
    """Rows are added until the last page is just begun; set closer they then fit on the pages before."""
    pictures, settings = {}, content.settings
    loose = _set(content, 1.0, pictures)
    for _ in range(2):  # up to the end of the page, and over it
        left = int((1.02 - loose.last_page_share) * 10.15 / 0.17)
        settings = (*settings, *((f"setting {n}", "0") for n in range(left)))
        loose = _set(replace(content, settings=settings), 1.0, pictures)
        if loose.last_page_share < 0.3:
            break
    assert loose.last_page_share < 0.3
    pdf = report_pdf(replace(content, settings=settings))
    assert len(re.findall(rb"/Type /Page\b", pdf)) == loose.page_count - 1


@pytest.mark.usefixtures("coarse")
def test_a_pdf_of_many_regions_goes_over_pages_that_are_numbered(content, tmp_path):
    many = replace(content.final.report, regions=content.final.report.regions * 90 or ())
    if not many.regions:
        many = replace(content.final.report, regions=content.first.report.regions * 90)
    long = replace(content, final=replace(content.final, report=many))
    text = text_of_pdf(report_pdf(long), tmp_path)
    pages = text.count("\f")
    assert pages >= 5
    assert all(f"page {number} of {pages}" in text for number in range(1, pages + 1))


def test_a_report_of_nothing_and_of_damage_says_so(tmp_path):
    with Record.open(tmp_path / "record.sqlite") as record:
        record.create_session("", state="created", settings=SessionSettings(max_points=1000).to_dict())
    reader = RecordReader.open(tmp_path / "record.sqlite")
    empty = read_session(reader, find_session(reader, "latest"), with_stages=True)
    reader.close()
    content = report_of(replace(empty, damaged=("line 3: its checksum <does> not match",)), NOW)
    html = report_html(content).decode("utf-8")
    assert "1 stored line cannot be read" in html
    assert "&lt;does&gt;" in html
    assert "There was one pass" in html
    assert report_pdf(content).startswith(b"%PDF-")


def test_rows_are_read_from_trees_of_numbers():
    tree = {"lines": {"refused": {}, "stored": 12345, "share": float("nan")}, "device": None, "ok": True}
    assert flat_rows(tree) == [
        ("lines · refused", "none"),
        ("lines · stored", "12\u202f345"),
        ("lines · share", "unknown"),
        ("device", "not set"),
        ("ok", "yes"),
    ]
    assert shown(0.123456789) == "0.123457"
