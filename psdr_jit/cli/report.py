"""One HTML page about a derivative or an optimisation, for a browser; it needs no network and no other file.

PATH: an EXR file that 'psdr gradient' has written (any other shows its layers as well), or the folder of a run of
'psdr optimize'. The page has every layer with values and standard errors under the pointer, and the curves of a run.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from psdr_jit.cli import common

NAME = "report"
HELP = "make one HTML page of a derivative or an optimisation"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("path", metavar="PATH", help="EXR file, or folder of an optimisation")
    parser.add_argument("-o", "--output", metavar="FILE.html",
                        help="the page (default: the file's name with .html beside it, or report.html in the folder)")
    parser.add_argument("--megabytes", type=float, default=5.0, metavar="MB",
                        help="largest page; values are rounded to fit, to 3 %% at worst (default: 5)")
    parser.add_argument("--quiet", action="store_true", help="print only errors")


def run(args: argparse.Namespace) -> int:
    """Read, write; 0."""
    common.require_positive(megabytes=args.megabytes)
    from psdr_jit.core import files
    from psdr_jit.derivative import images
    from psdr_jit.report import page, sources

    path = Path(args.path)
    beside = path / "report.html" if path.is_dir() else path.with_suffix(".html")
    output = images.check_writable(args.output or beside)
    written = page.html_of(sources.read(path), args.megabytes).encode()
    files.write_bytes(output, written)
    if not args.quiet:
        print(f"wrote {output} ({len(written) / 1e6:.1f} MB): open it in a browser")
    return 0
