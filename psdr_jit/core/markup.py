"""Small pieces of HTML for results that show themselves in notebooks. Plain where a viewer drops style sheets."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Sequence
from functools import cache
from html import escape
from importlib import resources


def card(title: str, about: str, *parts: str) -> str:
    """A result: what it is, in which circumstances, and `parts`, which are HTML."""
    head = f'<div class="psdr-title">{escape(title)}</div><div class="psdr-about">{escape(about)}</div>'
    return f'<div class="psdr-card"><style>{_style()}</style>{head}{"".join(parts)}</div>'


def table(header: Sequence[str], rows: Sequence[Sequence[str]], text: Sequence[int] = (0,)) -> str:
    """A table of plain texts; columns `text` are aligned on the left, the others are numbers. A header may be empty."""

    def line(cells: Sequence[str], tag: str) -> str:
        names = ["psdr-text" if k in text else "psdr-number" for k in range(len(cells))]
        inside = (f'<{tag} class="{n}">{escape(c)}</{tag}>' for n, c in zip(names, cells, strict=True))
        return f"<tr>{''.join(inside)}</tr>"

    body = "".join(line(row, "td") for row in rows)
    head = f"<thead>{line(header, 'th')}</thead>" if header else ""
    return f"<table>{head}<tbody>{body}</tbody></table>"


def note(text: str) -> str:
    """A line below a table."""
    return f'<div class="psdr-about">{escape(text)}</div>'


def badge(text: str, good: bool | None) -> str:
    """A verdict: good, bad, or neither (None)."""
    kind = {True: "good", False: "bad", None: "open"}[good]
    return f'<span class="psdr-badge psdr-{kind}">{escape(text)}</span>'


def picture(png: bytes, alt: str) -> str:
    """An image inside of the page."""
    return f'<img alt="{escape(alt)}" src="data:image/png;base64,{b64encode(png).decode()}"/>'


def bar(label: str, share: float, figures: str, remark: str) -> str:
    """A progress bar."""
    done = f"<span>{escape(label)}</span><progress max=1 value={share:.4f}></progress><span>{escape(figures)}</span>"
    done += f'<span class="psdr-about">{escape(remark)}</span>'
    return f'<div class="psdr-bar"><style>{_style()}</style>{done}</div>'


@cache
def _style() -> str:
    return (resources.files("psdr_jit.core") / "notebook.css").read_text(encoding="utf-8")
