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
body{font:15px/1.5 system-ui,sans-serif;margin:0 auto;max-width:1080px;padding:24px;color:#1c2733;background:#fbfcfd}
h1{font-size:26px;margin:0 0 4px}h2{font-size:19px;margin:32px 0 8px;border-bottom:1px solid #d5dde5;padding-bottom:4px}
figure{display:inline-block;margin:0 12px 14px 0;vertical-align:top}img,video{max-width:100%;border-radius:4px}
figcaption{color:#526272;font-size:13px;max-width:520px}table{border-collapse:collapse;margin:8px 0}
td,th{padding:4px 12px 4px 0;text-align:left;border-bottom:1px solid #e6ebf0;font-variant-numeric:tabular-nums}
.warn{background:#fff4d6;border-left:4px solid #e0a100;padding:8px 12px;margin:6px 0}
.ok{background:#e5f5ea;border-left:4px solid #2e9e5b;padding:8px 12px;margin:6px 0}
.sub{color:#526272;margin:0 0 12px}
"""


@dataclass(frozen=True)
class Figure:
    """A picture with a sentence below it."""

    picture: UInt8[np.ndarray, "h w 3"]
    text: str


@dataclass(frozen=True)
class Section:
    """A heading with tables, pictures and notes."""

    title: str
    figures: Sequence[Figure] = ()
    rows: Sequence[Sequence[Any]] = ()
    header: Sequence[str] = ()
    notes: Sequence[str] = field(default_factory=tuple)


def report_html(
    title: str, subtitle: str, sections: Sequence[Section], *, warnings: Sequence[str], links: Mapping[str, str]
) -> str:
    """A self-contained page: pictures are inside it, nothing is loaded from elsewhere.

    Args:
        title: heading.
        subtitle: one line below it.
        sections: in order.
        warnings: what the user should know, shown first.
        links: text to relative path of files beside the report.
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
    for section in sections:
        parts.append(f"<h2>{html.escape(section.title)}</h2>")
        parts += [f"<p>{html.escape(note)}</p>" for note in section.notes]
        if section.rows:
            parts.append(_table(section.header, section.rows))
        parts += [_figure(figure) for figure in section.figures]
    return "\n".join(parts) + "</html>\n"


def _table(header: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    head = "<tr>" + "".join(f"<th>{html.escape(str(c))}</th>" for c in header) + "</tr>" if header else ""
    body = "".join("<tr>" + "".join(f"<td>{html.escape(_text(c))}</td>" for c in row) + "</tr>" for row in rows)
    return f"<table>{head}{body}</table>"


def _text(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, list | tuple):
        return ", ".join(_text(v) for v in value)
    return str(value)


def _figure(figure: Figure) -> str:
    data = base64.b64encode(png_bytes(figure.picture)).decode()
    alt = html.escape(figure.text)
    return f"<figure><img alt='{alt}' src='data:image/png;base64,{data}'><figcaption>{alt}</figcaption></figure>"


def png_bytes(picture: UInt8[np.ndarray, "h w 3"]) -> bytes:
    """The picture as PNG."""
    import cv2

    ok, data = cv2.imencode(".png", np.ascontiguousarray(picture[..., ::-1]))
    if not ok:
        raise ValueError("a picture that cannot be encoded")
    return data.tobytes()
