"""A document as one HTML file that needs nothing else."""

from __future__ import annotations

import math
from html import escape
from importlib.resources import files

from gapbridge.bridge.document.blocks import (
    Badge,
    Bar,
    Block,
    Bullets,
    Cell,
    Columns,
    Document,
    Heading,
    Pairs,
    Paragraph,
    Part,
    Pictures,
    Strong,
    Table,
    Tiles,
    Verdict,
)
from gapbridge.bridge.document.svg import svg


def html(document: Document) -> str:
    """Return the whole page."""
    links = "".join(f'<a href="#{p.key}">{escape(p.title)}</a>' for p in document.parts)
    body = "".join(_part(part) for part in document.parts)
    title = escape(document.title)
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{title}</title>"
        # an empty icon keeps browsers from asking for one
        '<link rel="icon" href="data:,">'
        f"<style>{_own('gapbridge.bridge.report')}{_own('gapbridge.bridge.document')}</style></head><body>"
        f"<header><h1>{title}</h1><p>{escape(document.subtitle)}</p><nav>{links}</nav></header>"
        f"<main>{body}</main><footer><p>{escape(document.footer)}</p></footer></body></html>\n"
    )


def _own(package: str) -> str:
    return files(package).joinpath("style.css").read_text(encoding="utf-8")


def _part(part: Part) -> str:
    blocks = "".join(_block(block) for block in part.blocks)
    if part.folded:
        blocks = f"<details><summary>Show</summary>{blocks}</details>"
    return (
        f'<section id="{part.key}"><h2>{escape(part.title)}</h2>'
        f'<p class="about">{escape(part.about)}</p>{blocks}</section>'
    )


def _block(block: Block) -> str:
    if isinstance(block, Paragraph):
        css = f' class="{block.kind}"' if block.kind else ""
        return f"<p{css}>{escape(block.text)}</p>"
    if isinstance(block, Heading):
        return f"<h3>{escape(block.text)}</h3>"
    if isinstance(block, Bullets):
        return "<ul>" + "".join(f"<li>{escape(i)}</li>" for i in block.items) + "</ul>"
    if isinstance(block, Verdict):
        return (
            f'<p class="verdict">{_cell(block.badge)}</p><p class="lead">{escape(block.text)}</p>'
        )
    if isinstance(block, Tiles):
        return _tiles(block)
    if isinstance(block, Columns):
        return f'<div class="columns">{"".join(_pairs(p) for p in block.columns)}</div>'
    if isinstance(block, Table):
        return _table(block)
    return _pictures(block)


def _pairs(block: Pairs) -> str:
    title = f"<h3>{escape(block.title)}</h3>" if block.title else ""
    pairs = "".join(f"<dt>{escape(k)}</dt><dd>{escape(v)}</dd>" for k, v in block.pairs)
    return f'<div>{title}<dl class="pairs">{pairs}</dl></div>'


def _tiles(block: Tiles) -> str:
    tiles = "".join(
        f'<div class="tile"><span class="label">{escape(t.label)}</span>'
        f'<span class="value">{escape(t.value)}</span>'
        f'<span class="remark">{escape(t.note)}</span></div>'
        for t in block.tiles
    )
    return f'<div class="tiles">{tiles}</div>'


def _pictures(block: Pictures) -> str:
    drawings = "".join(svg(drawing) for drawing in block.drawings)
    caption = f"<figcaption>{escape(block.caption)}</figcaption>" if block.caption else ""
    return f'<figure><div class="drawings">{drawings}</div>{caption}</figure>'


def _table(block: Table) -> str:
    right = [' class="number"' if i in block.numbers else "" for i in range(len(block.heads))]
    head = "".join(f"<th{r}>{escape(h)}</th>" for h, r in zip(block.heads, right, strict=True))
    first_sum = len(block.rows) - block.sums
    body = "".join(
        ("<tr>" if number < first_sum else '<tr class="sum">')
        + "".join(
            # the label stands beside the cell where a phone shows each row as a card
            f'<td{r} data-label="{escape(h)}"><div>{_cell(c)}</div></td>'
            if c != ""
            else "<td></td>"
            for h, c, r in zip(block.heads, cells, right, strict=True)
        )
        + "</tr>"
        for number, cells in enumerate(block.rows)
    )
    kind = ' class="cards"' if len(block.heads) > 3 else ""
    return (
        f'<div class="wide"><table{kind}><thead><tr>{head}</tr></thead>'
        f"<tbody>{body}</tbody></table></div>"
    )


def _cell(cell: Cell) -> str:
    if isinstance(cell, Strong):
        return f"<b>{escape(cell.text)}</b>"
    if isinstance(cell, Badge):
        return f'<span class="badge {cell.kind}">{escape(cell.text)}</span>'
    if isinstance(cell, Bar):
        share = min(max(cell.share, 0.0), 1.0) if math.isfinite(cell.share) else 0.0
        return (
            f'<span class="share"><span class="bar"><i style="width:{share * 100:.0f}%">'
            f"</i></span>{escape(cell.text)}</span>"
        )
    return escape(cell)
