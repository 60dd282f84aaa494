"""A report as a PDF of A4 pages, to be printed and kept; drawn by matplotlib, so that nothing else need be installed.

Tables go over as many pages as they need. Text is set by hand: a page is a figure, a cursor runs down it.
"""

import textwrap
from collections.abc import Callable, Iterable, Sequence
from datetime import datetime
from io import BytesIO

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.figure import Figure
from matplotlib.image import imread
from matplotlib.lines import Line2D
from matplotlib.text import Text

from scanner_service.storage.exports.density_png import drawable
from scanner_service.storage.exports.report_charts import draw_coverage, draw_histogram
from scanner_service.storage.exports.report_content import ReportContent, Verdictful, amount, shown
from scanner_service.storage.exports.report_html import (
    AFTER,
    BEFORE,
    FATES,
    HISTOGRAM,
    MOST_REGIONS,
    REPEATABLE,
    map_png,
    percent,
    region_row,
)

FloatArray = npt.NDArray[np.float32]
_WIDTH, _HEIGHT = 8.27, 11.69  # A4 in inches
_LEFT, _RIGHT, _TOP, _BOTTOM = 0.75, 7.6, 10.95, 0.8
_INK, _SOFT, _LINE = "#1d232b", "#5b6572", "#d9dee4"
_PICTURE_DPI = 220
_POINT = 1 / 72
_NEARLY_EMPTY = 0.35  # of a page
_AS_TYPED = ("-liga",)  # an id that is copied from a page must be the id: no letters drawn as one
_TIGHTER = (0.93, 0.87)  # closer than that the lines of a table can no longer be told apart


def report_pdf(content: ReportContent) -> bytes:
    """The whole report as a PDF; its lines move together where the last page would be nearly empty otherwise."""
    pictures: dict[int, FloatArray] = {}
    books = [_set(content, 1.0, pictures)]
    if books[0].last_page_share < _NEARLY_EMPTY:
        books += [_set(content, pitch, pictures) for pitch in _TIGHTER]
    return min(books, key=lambda book: (book.page_count, -book.pitch)).to_bytes()


def _set(content: ReportContent, pitch: float, pictures: dict[int, FloatArray]) -> "_Book":
    book = _Book(content, pitch, pictures)
    book.title()
    book.figures()
    book.headline("Density")
    book.map(content.final, AFTER, 4.9)
    book.histogram()
    book.headline("Coverage, pass by pass")
    book.passes()
    book.headline("Regions to scan again")
    book.regions()
    book.before()
    book.headline("Losses")
    book.text("Every line and every point that came in, and what became of it.")
    for name, rows in content.losses:
        book.rows(name, rows)
    book.headline("How it was found")
    book.rows("Settings", content.settings)
    book.rows("The scan in figures", content.facts)
    book.headline("Where it comes from")
    book.rows("", [("software", content.software), ("report written", content.written)])
    book.rows(
        "", [("SHA-256 of the raw lines", content.raw_sha256), ("SHA-256 of the verdict", content.verdict_sha256)]
    )
    book.text(REPEATABLE)
    return book


class _Book:
    """Pages with a cursor; `_y` is where the next thing goes, in inches from the bottom.

    `pitch` is how far apart the lines of tables and lists are, 1 as a rule; `pictures` are those that were drawn.
    """

    def __init__(self, content: ReportContent, pitch: float, pictures: dict[int, FloatArray]) -> None:
        self.pitch = pitch
        self._pictures = pictures
        self._content = content
        self._pages: list[Figure] = []
        self._y = 0.0
        self._new_page()

    @property
    def page_count(self) -> int:
        """How many pages there are."""
        return len(self._pages)

    @property
    def last_page_share(self) -> float:
        """How much of the last page is taken, 0 to 1."""
        return (_TOP - self._y) / (_TOP - _BOTTOM)

    def title(self) -> None:
        """Name of the session, and which it is."""
        content = self._content
        for line in textwrap.wrap(drawable(content.title), 32)[:3] or ["scan"]:
            self._put(line, 22, bold=True)
        self._put(f"Scan report · session {content.session_id} · scanned {content.created} · {content.state}", 9, _SOFT)
        if content.damaged:
            self._y -= 0.1
            self.text(f"{len(content.damaged)} stored lines cannot be read and are left out; {content.damaged[0]}")

    def figures(self) -> None:
        """The few numbers that matter most, in boxes."""
        self._y -= 0.12
        items = self._content.headlines
        each = (_RIGHT - _LEFT) / max(len(items), 1)
        for place, (name, value) in enumerate(items):
            x = _LEFT + place * each
            self._line(x, self._y, x, self._y - 0.52, "#3b6ea5", 2.5)
            self._at(x + 0.1, self._y - 0.25, value, 14, bold=True)
            self._at(x + 0.1, self._y - 0.46, name, 7.5, _SOFT)
        self._y -= 0.7

    def headline(self, text: str) -> None:
        """A heading that is not left alone at the foot of a page."""
        self._room(1.4)
        self._y -= 0.22
        self._put(text, 13, bold=True)
        self._line(_LEFT, self._y + 0.02, _RIGHT, self._y + 0.02, _INK, 1.2)
        self._y -= 0.08

    def text(self, text: str, size: float = 9) -> None:
        """A paragraph."""
        for line in textwrap.wrap(drawable(text), 112):
            self._room(0.2)
            self._put(line, size)
        self._y -= 0.06

    def map(self, found: Verdictful, caption: str, highest: float) -> None:
        """A density map, as wide as the page or as high as told."""
        pixels = self._pictures.get(id(found))
        if pixels is None:
            pixels = imread(BytesIO(map_png(self._content, found, _PICTURE_DPI)), format="png")
            self._pictures[id(found)] = pixels
        width = min(_RIGHT - _LEFT, highest * pixels.shape[1] / pixels.shape[0])
        height = width * pixels.shape[0] / pixels.shape[1]
        self._room(height + 0.3)
        left = (_LEFT + _RIGHT - width) / 2
        axes = self._pages[-1].add_axes(self._box(left, self._y - height, width, height))
        axes.imshow(pixels, aspect="auto", interpolation="none")
        axes.set_axis_off()
        self._y -= height + 0.05
        self._put(caption, 8, _SOFT)

    def histogram(self) -> None:
        """How many points have which density."""
        self._chart(lambda axes: draw_histogram(axes, self._content.final.snapshot, self._content.required_per_mm2))
        self.text(HISTOGRAM, 8)

    def passes(self) -> None:
        """Coverage after each pass, as a chart and as a table."""
        content = self._content
        if len(content.passes) > 1:
            self._chart(lambda axes: draw_coverage(axes, content.passes))
        if content.pass_ends > len(content.passes):
            self.text(f"{content.pass_ends} passes ended; {len(content.passes)} of them are shown.")
        self._table(
            (("after", 1.3, False), ("lines", 0.7, True), ("points", 0.9, True), ("coverage", 0.8, True),
             ("surface mm²", 0.95, True), ("gaps mm²", 0.8, True), ("regions", 0.6, True), ("again mm²", 0.8, True)),
            [(row.name, shown(row.lines), shown(row.points), percent(row.coverage), amount(row.touched_mm2),
              amount(row.gap_mm2, 1), shown(row.regions), amount(row.region_mm2, 1)) for row in content.passes],
        )  # fmt: skip

    def regions(self) -> None:
        """The list of regions."""
        regions = self._content.final.report.regions
        if not regions:
            self.text("None: what was seen meets the requirement.")
            return
        self._table(
            (("#", 0.35, True), ("reason", 0.8, False), ("remedy", 1.35, False), ("area mm²", 0.75, True),
             ("measured", 0.8, True), ("required", 0.8, True), ("priority", 0.6, True), ("at x, y, z mm", 1.4, True)),
            [region_row(region) for region in regions[:MOST_REGIONS]],
        )  # fmt: skip
        if len(regions) > MOST_REGIONS:
            self.text(f"The first {MOST_REGIONS} of {len(regions)} regions; regions.json lists all.")

    def before(self) -> None:
        """What became of the regions of the first pass."""
        content = self._content
        if content.first is None:
            self.text("There was one pass, so there is no before and after.")
            return
        self._room(5.6)  # heading, words and map stay together
        self.headline("Before and after")
        self.text(FATES)
        self.map(content.first, BEFORE, 4.0)
        if not content.fates:
            self.text("The first pass had left none.")
            return
        self._table(
            (("in the map", 0.8, False), ("reason", 1.4, False), ("area mm²", 1.1, True), ("still wanting", 1.1, True),
             ("outcome", 1.6, False)),
            [(fate.name, fate.reason, amount(fate.area_mm2, 1), percent(fate.left_share), fate.outcome)
             for fate in content.fates[:MOST_REGIONS]],
        )  # fmt: skip

    def rows(self, name: str, rows: Iterable[tuple[str, str]]) -> None:
        """Names and values, one a line."""
        if name:
            self._room(0.7)
            self._y -= 0.08
            self._put(name, 9.5, bold=True)
        for left, right in rows:
            lines = textwrap.wrap(drawable(right), 58) or [""]
            self._room(0.17 * self.pitch * len(lines) + 0.05)
            for number, line in enumerate(lines):
                if number == 0:
                    self._at(_LEFT, self._y - 0.13, left, 8, _SOFT)
                self._at(_LEFT + 2.6, self._y - 0.13, line, 8)
                self._y -= 0.17 * self.pitch
            self._line(_LEFT, self._y - 0.02, _RIGHT, self._y - 0.02, _LINE, 0.5)
        self._y -= 0.06

    def to_bytes(self) -> bytes:
        """All pages, numbered."""
        content = self._content
        for number, page in enumerate(self._pages, start=1):
            self._at(_LEFT, 0.45, f"{content.title[:60]} · session {content.session_id}", 7.5, _SOFT, page=page)
            self._at(
                _RIGHT, 0.45, f"{content.software} · page {number} of {len(self._pages)}", 7.5, _SOFT, "right", page
            )
        file = BytesIO()
        facts = {"Title": f"{drawable(content.title)} – scan report", "Creator": content.software}
        with PdfPages(file, metadata={**facts, "CreationDate": _when(content.written)}) as pages:
            for page in self._pages:
                for label in page.findobj(Text):
                    label.set_fontfeatures(_AS_TYPED)
                pages.savefig(page)
        return file.getvalue()

    # -- inside ----------------------------------------------------------------------------------------------------

    def _new_page(self) -> None:
        page = Figure(figsize=(_WIDTH, _HEIGHT), facecolor="white")
        FigureCanvasAgg(page)
        self._pages.append(page)
        self._y = _TOP

    def _room(self, inches: float) -> None:
        """Turn the page when less than that is left."""
        if self._y - inches < _BOTTOM:
            self._new_page()

    def _chart(self, draw: Callable[[Axes], None], height: float = 2.1) -> None:
        self._room(height + 0.3)
        axes = self._pages[-1].add_axes(
            self._box(_LEFT + 0.65, self._y - height + 0.42, _RIGHT - _LEFT - 1.3, height - 0.5)
        )
        draw(axes)
        self._y -= height + 0.06

    def _table(self, columns: Sequence[tuple[str, float, bool]], rows: Iterable[Sequence[str]]) -> None:
        """A table whose head is repeated on each page; columns are (name, width in inches, right-aligned)."""
        self._room(0.6)
        self._cells(columns, [name for name, _, _ in columns], head=True)
        for row in rows:
            wrapped = [
                textwrap.wrap(drawable(text), max(4, int(15.5 * width))) or [""]
                for text, (_, width, _) in zip(row, columns, strict=True)
            ]
            height = max(len(lines) for lines in wrapped)
            if self._y - 0.16 * self.pitch * height - 0.05 < _BOTTOM:
                self._new_page()
                self._cells(columns, [name for name, _, _ in columns], head=True)
            for number in range(height):
                self._cells(columns, [lines[number] if number < len(lines) else "" for lines in wrapped])
            self._line(_LEFT, self._y - 0.02, _RIGHT, self._y - 0.02, _LINE, 0.5)
            self._y -= 0.02
        self._y -= 0.1

    def _cells(self, columns: Sequence[tuple[str, float, bool]], texts: Sequence[str], head: bool = False) -> None:
        x = _LEFT
        for text, (_, width, is_number) in zip(texts, columns, strict=True):
            place = x + width - 0.12 if is_number else x
            self._at(place, self._y - 0.13, text, 7.8, _INK, "right" if is_number else "left", bold=head)
            x += width
        self._y -= 0.16 * self.pitch
        if head:
            self._line(_LEFT, self._y - 0.02, _RIGHT, self._y - 0.02, _INK, 0.9)
            self._y -= 0.03

    def _put(self, text: str, size: float, colour: str = _INK, bold: bool = False) -> None:
        """A line of text at the cursor, which moves down."""
        self._at(_LEFT, self._y - size * _POINT, text, size, colour, bold=bold)
        self._y -= 1.45 * size * _POINT

    def _at(
        self, x: float, y: float, text: str, size: float, colour: str = _INK, align: str = "left",
        page: Figure | None = None, bold: bool = False,
    ) -> None:  # fmt: skip
        label = Text(
            x / _WIDTH, y / _HEIGHT, drawable(text), fontsize=size, color=colour, ha=align, va="baseline",
            fontweight="bold" if bold else "normal", parse_math=False,
        )  # fmt: skip
        figure = page or self._pages[-1]
        label.set_figure(figure)
        label.set_transform(figure.transFigure)
        figure.texts.append(label)

    def _line(self, x0: float, y0: float, x1: float, y1: float, colour: str, width: float) -> None:
        line = Line2D([x0 / _WIDTH, x1 / _WIDTH], [y0 / _HEIGHT, y1 / _HEIGHT], color=colour, linewidth=width)
        self._pages[-1].add_artist(line)

    def _box(self, left: float, bottom: float, width: float, height: float) -> tuple[float, float, float, float]:
        return left / _WIDTH, bottom / _HEIGHT, width / _WIDTH, height / _HEIGHT


def _when(text: str) -> datetime:
    return datetime.fromisoformat(text.replace("Z", "+00:00"))
