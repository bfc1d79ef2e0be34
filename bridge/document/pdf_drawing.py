"""A drawing as a part of a PDF page."""

from __future__ import annotations

from reportlab.lib.colors import HexColor
from reportlab.pdfgen.canvas import Canvas
from reportlab.platypus import Flowable

from gapbridge.bridge.document.drawing import (
    PALETTE,
    Circle,
    Dots,
    Drawing,
    Line,
    Rectangle,
    Shape,
    Stroke,
    Text,
)
from gapbridge.bridge.document.pdf_text import BOLD, PLAIN


class DrawnRow(Flowable):
    """Drawings side by side, made smaller together where they are wider than the page."""

    def __init__(self, drawings: tuple[Drawing, ...], gap: float = 16.0, largest: float = 0.76):
        super().__init__()
        self.drawings, self.gap, self.scale = drawings, gap, largest

    def wrap(self, available_width: float, available_height: float) -> tuple[float, float]:
        """Return the size that the row takes, pt."""
        gaps = self.gap * (len(self.drawings) - 1)
        wanted = sum(d.width for d in self.drawings)
        self.scale = min(self.scale, (available_width - gaps) / wanted)
        return available_width, max(d.height for d in self.drawings) * self.scale + 4

    def draw(self) -> None:
        """Draw the row on the canvas that the page gives."""
        canvas: Canvas = self.canv
        tallest = max(d.height for d in self.drawings) * self.scale
        x = 0.0
        for drawing in self.drawings:
            canvas.saveState()
            canvas.translate(x, tallest)
            canvas.scale(self.scale, self.scale)
            for shape in drawing.shapes:
                _shape(canvas, shape)
            canvas.restoreState()
            x += drawing.width * self.scale + self.gap


def _shape(canvas: Canvas, shape: Shape) -> None:
    """Draw one shape; a page counts y upwards."""
    if isinstance(shape, Line):
        _stroke(canvas, shape.stroke)
        path = canvas.beginPath()
        path.moveTo(shape.points[0][0], -shape.points[0][1])
        for x, y in shape.points[1:]:
            path.lineTo(x, -y)
        canvas.drawPath(path)
    elif isinstance(shape, Rectangle):
        canvas.setFillColor(HexColor(PALETTE[shape.fill]))
        canvas.rect(shape.x, -shape.y - shape.height, shape.width, shape.height, 0, 1)
    elif isinstance(shape, Dots):
        _stroke(canvas, Stroke(shape.fill, 2 * shape.radius))
        canvas.setLineCap(1)
        canvas.setStrokeAlpha(shape.opacity)
        canvas.lines([(x, -y, x, -y) for x, y in shape.points])
        canvas.setStrokeAlpha(1.0)
        canvas.setLineCap(0)
    elif isinstance(shape, Circle):
        if shape.stroke:
            _stroke(canvas, shape.stroke)
        if shape.fill:
            canvas.setFillColor(HexColor(PALETTE[shape.fill]))
            canvas.setFillAlpha(shape.opacity)
        canvas.circle(
            shape.x, -shape.y, shape.radius, int(bool(shape.stroke)), int(bool(shape.fill))
        )
        canvas.setFillAlpha(1.0)
    else:
        _text(canvas, shape)


def _text(canvas: Canvas, shape: Text) -> None:
    canvas.saveState()
    canvas.setFillColor(HexColor(PALETTE[shape.colour]))
    canvas.setFont(BOLD if shape.bold else PLAIN, shape.size)
    canvas.translate(shape.x, -shape.y)
    if shape.turned:
        canvas.rotate(90)
    draw = {"start": canvas.drawString, "middle": canvas.drawCentredString,
            "end": canvas.drawRightString}[shape.anchor]  # fmt: skip
    draw(0, 0, shape.text)
    canvas.restoreState()


def _stroke(canvas: Canvas, stroke: Stroke) -> None:
    canvas.setStrokeColor(HexColor(PALETTE[stroke.colour]))
    canvas.setLineWidth(stroke.width)
    canvas.setLineJoin(1)
    canvas.setDash([4, 3] if stroke.dashed else [])
