"""Write a drawing as SVG."""

from __future__ import annotations

from html import escape

from gapbridge.bridge.document.drawing import (
    DARK,
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


def colours() -> str:
    """Return the CSS that gives the palette's names their colours, light and dark."""
    light, dark = (
        "".join(f"--{name}:{colour};" for name, colour in palette.items())
        for palette in (PALETTE, DARK)
    )
    return f":root{{{light}}}@media screen and (prefers-color-scheme:dark){{:root{{{dark}}}}}"


def svg_file(drawing: Drawing) -> str:
    """Return the drawing as a standalone SVG file."""
    style = f"<style>{colours()}text{{font-family:system-ui,sans-serif}}</style>"
    return svg(drawing, style) + "\n"


def svg(drawing: Drawing, style: str = "") -> str:
    """Return the drawing as an SVG element, scaled to its container up to 1.45 times its width."""
    width, height = _number(drawing.width), _number(drawing.height)
    widest = _number(1.45 * drawing.width)
    shapes = "".join(_shape(shape) for shape in drawing.shapes)
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" '
        f'width="{width}" height="{height}" style="max-width:min(100%,{widest}px)" role="img" '
        f'aria-label="{escape(drawing.title)}">{style}{shapes}</svg>'
    )


def _shape(shape: Shape) -> str:
    if isinstance(shape, Line):
        points = " ".join(f"{_number(x)},{_number(y)}" for x, y in shape.points)
        return f'<polyline points="{points}" fill="none" {_stroke(shape.stroke)}/>'
    if isinstance(shape, Rectangle):
        return (
            f'<rect x="{_number(shape.x)}" y="{_number(shape.y)}" width="{_number(shape.width)}" '
            f'height="{_number(shape.height)}" fill="var(--{shape.fill})">'
            f"{_hint(shape.hint)}</rect>"
        )
    if isinstance(shape, Dots):
        places = "".join(f"M{_number(x)} {_number(y)}h0" for x, y in shape.points)
        return (
            f'<path class="dots" d="{places}" fill="none" stroke="var(--{shape.fill})" '
            f'stroke-width="{_number(2 * shape.radius)}" stroke-linecap="round" '
            f'stroke-opacity="{_number(shape.opacity)}"/>'
        )
    if isinstance(shape, Circle):
        solid = "" if shape.opacity == 1.0 else f' fill-opacity="{_number(shape.opacity)}"'
        return (
            f'<circle cx="{_number(shape.x)}" cy="{_number(shape.y)}" r="{_number(shape.radius)}" '
            f'fill="var(--{shape.fill})"{solid}>{_hint(shape.hint)}</circle>'
        )
    return _text(shape)


def _text(shape: Text) -> str:
    x, y = _number(shape.x), _number(shape.y)
    turned = f' transform="rotate(-90 {x} {y})"' if shape.turned else ""
    bold = ' font-weight="600"' if shape.bold else ""
    return (
        f'<text x="{x}" y="{y}" font-size="{_number(shape.size)}" fill="var(--{shape.colour})" '
        f'text-anchor="{shape.anchor}"{bold}{turned}>{escape(shape.text)}</text>'
    )


def _stroke(stroke: Stroke) -> str:
    dashes = ' stroke-dasharray="4 3"' if stroke.dashed else ""
    return (
        f'stroke="var(--{stroke.colour})" stroke-width="{_number(stroke.width)}" '
        f'stroke-linejoin="round"{dashes}'
    )


def _hint(text: str) -> str:
    return f"<title>{escape(text)}</title>" if text else ""


def _number(value: float) -> str:
    return f"{value:.2f}".rstrip("0").rstrip(".")
