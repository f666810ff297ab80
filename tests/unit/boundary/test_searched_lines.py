"""What is searched for crossings, whichever end its chains start at."""

from __future__ import annotations

from psdr_jit.boundary.chain_lines import Lines
from psdr_jit.boundary.light_chain_lines import LightLines
from psdr_jit.boundary.searched_lines import SearchedLines


def test_lines_of_both_ends_are_compared_in_one_way():
    for lines in (Lines, LightLines):
        assert issubclass(lines, SearchedLines)
        assert not lines.__abstractmethods__
        assert lines.compare is SearchedLines.compare and lines.guide is SearchedLines.guide
