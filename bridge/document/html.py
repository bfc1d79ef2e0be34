"""Write a document as one self-contained HTML file."""

from __future__ import annotations

import json
from collections.abc import Callable
from html import escape
from importlib.resources import files

from gapbridge.bridge.document import blocks
from gapbridge.bridge.document.svg import colours, svg


def html(document: blocks.Document) -> str:
    """Return the page."""
    links = "".join(f'<a href="#{p.key}">{escape(p.title)}</a>' for p in document.parts)
    body = "".join(_part(part) for part in document.parts)
    title = escape(document.title)
    interactive = any(
        isinstance(b, blocks.Gallery | blocks.View) for p in document.parts for b in p.blocks
    )
    script = (
        f'<script type="module">{_file("view.js")}{_file("page.js")}</script>'
        if interactive
        else ""
    )
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        '<meta name="color-scheme" content="light dark">'
        f"<title>{title}</title>"
        # an empty icon keeps browsers from asking for one
        '<link rel="icon" href="data:,">'
        f"<style>{colours()}{_file('style.css')}</style></head><body>"
        f"<header><h1>{title}</h1><p>{escape(document.subtitle)}</p><nav>{links}</nav></header>"
        f"<main>{body}</main><footer><p>{escape(document.footer)}</p></footer>"
        f"{script}</body></html>\n"
    )


def _file(name: str) -> str:
    return files("gapbridge.bridge.document").joinpath(name).read_text(encoding="utf-8")


def _part(part: blocks.Part) -> str:
    content = "".join(_block(block) for block in part.blocks)
    if part.folded:
        content = f"<details><summary>Show</summary>{content}</details>"
    return (
        f'<section id="{part.key}"><h2>{escape(part.title)}</h2>'
        f'<p class="about">{escape(part.about)}</p>{content}</section>'
    )


def _block(block: blocks.Block) -> str:
    return _WRITERS[type(block)](block)


def _paragraph(block: blocks.Paragraph) -> str:
    css = f' class="{block.kind}"' if block.kind else ""
    return f"<p{css}>{escape(block.text)}</p>"


def _heading(block: blocks.Heading) -> str:
    return f"<h3>{escape(block.text)}</h3>"


def _bullets(block: blocks.Bullets) -> str:
    return "<ul>" + "".join(f"<li>{escape(i)}</li>" for i in block.items) + "</ul>"


def _verdict(block: blocks.Verdict) -> str:
    badges = " ".join(_cell(badge) for badge in (block.badge, *block.more))
    return f'<p class="verdict">{badges}</p><p class="lead">{escape(block.text)}</p>'


def _columns(block: blocks.Columns) -> str:
    return f'<div class="columns">{"".join(_pairs(p) for p in block.columns)}</div>'


def _table_row(block: blocks.TableRow) -> str:
    return f'<div class="grid">{"".join(f"<div>{_table(t)}</div>" for t in block.tables)}</div>'


def _pairs(block: blocks.Pairs) -> str:
    title = f"<h3>{escape(block.title)}</h3>" if block.title else ""
    pairs = "".join(f"<dt>{escape(k)}</dt><dd>{escape(v)}</dd>" for k, v in block.pairs)
    return f'<div>{title}<dl class="pairs">{pairs}</dl></div>'


def _tiles(block: blocks.Tiles) -> str:
    tiles = "".join(
        f'<div class="tile"><span class="label">{escape(t.label)}</span>'
        f'<span class="value">{escape(t.value)}</span>'
        f'<span class="remark">{escape(t.note)}</span></div>'
        for t in block.tiles
    )
    return f'<div class="tiles">{tiles}</div>'


def _pictures(block: blocks.Pictures) -> str:
    drawings = "".join(svg(drawing) for drawing in block.drawings)
    return _figure(f'<div class="drawings">{drawings}</div>', block.caption)


def _gallery(block: blocks.Gallery) -> str:
    menus = "".join(
        f"<label>{escape(title)} <select>"
        + "".join(f"<option>{escape(entry)}</option>" for entry in entries)
        + "</select></label>"
        for title, entries in block.menus
        if len(entries) > 1
    )
    menu = f'<div class="menus">{menus}</div>' if menus else ""
    shown = "".join(
        f'<div class="drawings"{" hidden" if i else ""}>{svg(drawing)}</div>'
        for i, drawing in enumerate(block.drawings)
    )
    return _figure(f"{menu}{shown}", block.caption, "gallery")


def _view(block: blocks.View) -> str:
    data = json.dumps(block.scene.document(), separators=(",", ":")).replace("<", "\\u003c")
    return _figure(
        f'<canvas class="view" tabindex="0" role="img" aria-label="{escape(block.scene.title)}">'
        f'</canvas><script type="application/json">{data}</script>'
        f"<noscript>{svg(block.scene.drawing())}</noscript>",
        block.caption,
    )


def _figure(body: str, caption: str, kind: str = "") -> str:
    text = f"<figcaption>{escape(caption)}</figcaption>" if caption else ""
    css = f' class="{kind}"' if kind else ""
    return f"<figure{css}>{body}{text}</figure>"


def _table(block: blocks.Table) -> str:
    right = [' class="number"' if i in block.numbers else "" for i in range(len(block.heads))]
    head = "".join(f"<th{r}>{escape(h)}</th>" for h, r in zip(block.heads, right, strict=True))
    first_sum = len(block.rows) - block.sums
    body = "".join(
        ("<tr>" if number < first_sum else '<tr class="sum">')
        + "".join(
            # on a phone each row is a card that shows the label of every cell
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


def _cell(cell: blocks.Cell) -> str:
    if isinstance(cell, blocks.Strong):
        return f"<b>{escape(cell.text)}</b>"
    if isinstance(cell, blocks.Badge):
        return f'<span class="badge {cell.kind}">{escape(cell.text)}</span>'
    if isinstance(cell, blocks.Bar):
        return (
            f'<span class="share"><span class="bar"><i style="width:{cell.filled * 100:.0f}%;'
            f'background:var(--{cell.colour})"></i></span>{escape(cell.text)}</span>'
        )
    if isinstance(cell, blocks.Named):
        text = f"<b>{escape(cell.text)}</b>{escape(cell.more)}" if cell.text else ""
        line = "<br>" if text and cell.code else ""
        return text + (f"{line}<code>{escape(cell.code)}</code>" if cell.code else "")
    return escape(cell)


_WRITERS: dict[type, Callable[..., str]] = {
    blocks.Verdict: _verdict, blocks.Tiles: _tiles, blocks.Heading: _heading,
    blocks.Paragraph: _paragraph, blocks.Bullets: _bullets, blocks.Columns: _columns,
    blocks.Table: _table, blocks.TableRow: _table_row, blocks.Pictures: _pictures,
    blocks.Gallery: _gallery, blocks.View: _view,
}  # fmt: skip
