"""The report: one HTML file with everything in it."""

from __future__ import annotations

import base64
import html
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import UInt8

_STYLE = """
:root{color-scheme:light dark;--ink:#1c2733;--soft:#526272;--paper:#fbfcfd;--card:#fff;--line:#d9e1e8;--link:#0b62a8;
--warn:#fff4d6;--warn-edge:#e0a100;--ok:#e5f5ea;--ok-edge:#2e9e5b}
@media(prefers-color-scheme:dark){:root{--ink:#dfe6ed;--soft:#98a6b5;--paper:#14191f;--card:#1b222a;--line:#313c48;
--link:#74b6ee;--warn:#3b2f0c;--warn-edge:#d9a514;--ok:#12301f;--ok-edge:#3fb171}}
body{font:15px/1.55 system-ui,sans-serif;margin:0 auto;max-width:1120px;padding:24px;color:var(--ink);
background:var(--paper)}a{color:var(--link)}
h1{font-size:27px;margin:0 0 4px}h2{font-size:19px;margin:36px 0 10px;border-bottom:1px solid var(--line);
padding-bottom:4px}
.figures{display:grid;grid-template-columns:repeat(auto-fit,minmax(min(100%,320px),1fr));gap:16px;margin:12px 0}
figure{margin:0;background:var(--card);border:1px solid var(--line);border-radius:8px;overflow:hidden}
figure img{display:block;width:100%;height:auto;image-rendering:auto;cursor:zoom-in}
figure.wide,figure:focus-within{grid-column:1/-1}
pre{background:var(--card);border:1px solid var(--line);border-radius:8px;padding:10px 12px;overflow-x:auto}
figcaption{padding:8px 12px 10px;font-size:13.5px}figcaption .good{color:var(--soft);display:block;margin-top:2px}
video{width:100%;border-radius:8px;background:#000}
.table{overflow-x:auto}table{border-collapse:collapse;margin:8px 0}
td,th{padding:4px 14px 4px 0;text-align:left;border-bottom:1px solid var(--line);font-variant-numeric:tabular-nums}
.warn{background:var(--warn);border-left:4px solid var(--warn-edge);padding:8px 12px;margin:6px 0}
.ok{background:var(--ok);border-left:4px solid var(--ok-edge);padding:8px 12px;margin:6px 0}
.sub{color:var(--soft);margin:0 0 12px}
"""
WIDE = 1.7
"""width over height from which a picture, two side by side for instance, takes the whole width at once; others do while
they are clicked"""


@dataclass(frozen=True)
class Figure:
    """A picture with what it shows below it."""

    picture: UInt8[np.ndarray, "h w 3"]
    text: str
    good: str = ""
    """what it looks like where all is well"""


@dataclass(frozen=True)
class Section:
    """A heading with tables, pictures and notes."""

    title: str
    figures: Sequence[Figure] = ()
    rows: Sequence[Sequence[Any]] = ()
    header: Sequence[str] = ()
    notes: Sequence[str] = field(default_factory=tuple)
    commands: Sequence[tuple[str, str]] = ()
    """to be typed, each with what it does"""


def report_html(
    title: str,
    subtitle: str,
    sections: Sequence[Section],
    *,
    warnings: Sequence[str],
    links: Mapping[str, str],
    film: bytes = b"",
) -> str:
    """A self-contained page: pictures are inside it, nothing is loaded from elsewhere.

    Args:
        title: heading.
        subtitle: one line below it.
        sections: in order.
        warnings: what the user should know, shown first.
        links: text to relative path of files beside the report.
        film: an MP4 file that is shown first; empty: none.
    """
    parts = [
        "<!doctype html><html lang=en><meta charset=utf-8><meta name=viewport content='width=device-width'>",
        f"<title>{html.escape(title)}</title><style>{_STYLE}</style>",
        f"<h1>{html.escape(title)}</h1><p class=sub>{html.escape(subtitle)}</p>",
    ]
    if warnings:
        parts += [f"<div class=warn>{html.escape(w)}</div>" for w in warnings]
    else:
        parts.append("<div class=ok>No warnings.</div>")
    anchors = " · ".join(f"<a href='{html.escape(path)}'>{html.escape(text)}</a>" for text, path in links.items())
    parts.append(f"<p>{anchors}</p>")
    if film:
        source = "data:video/mp4;base64," + base64.b64encode(film).decode()
        parts.append(f"<video controls loop muted autoplay playsinline src='{source}'></video>")
    for section in sections:
        parts.append(f"<h2>{html.escape(section.title)}</h2>")
        parts += [f"<p>{html.escape(note)}</p>" for note in section.notes]
        if section.commands:
            width = max(len(command) for command, _ in section.commands)
            lines = [f"{command:{width}}   # {what}" for command, what in section.commands]
            parts.append(f"<pre>{html.escape(chr(10).join(lines))}</pre>")
        if section.rows:
            parts.append(_table(section.header, section.rows))
        if section.figures:
            parts.append("<div class=figures>" + "".join(_figure(figure) for figure in section.figures) + "</div>")
    return "\n".join(parts) + "</html>\n"


def _table(header: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    head = "<tr>" + "".join(f"<th>{html.escape(str(c))}</th>" for c in header) + "</tr>" if header else ""
    body = "".join("<tr>" + "".join(f"<td>{html.escape(_text(c))}</td>" for c in row) + "</tr>" for row in rows)
    return f"<div class=table><table>{head}{body}</table></div>"


def _text(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, list | tuple):
        return ", ".join(_text(v) for v in value)
    return str(value)


def _figure(figure: Figure) -> str:
    data = base64.b64encode(png_bytes(figure.picture)).decode()
    alt = html.escape(figure.text)
    good = f"<span class=good>Good: {html.escape(figure.good)}.</span>" if figure.good else ""
    picture = f"<img tabindex=0 alt='{alt}' src='data:image/png;base64,{data}'>"
    wide = " class=wide" if figure.picture.shape[1] > WIDE * figure.picture.shape[0] else ""
    return f"<figure{wide}>{picture}<figcaption>{alt}.{good}</figcaption></figure>"


def png_bytes(picture: UInt8[np.ndarray, "h w 3"]) -> bytes:
    """The picture as PNG."""
    import cv2

    ok, data = cv2.imencode(".png", np.ascontiguousarray(picture[..., ::-1]))
    if not ok:
        raise ValueError("a picture that cannot be encoded")
    return data.tobytes()
