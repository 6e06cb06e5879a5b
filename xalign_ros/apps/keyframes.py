"""xalign keyframes: a list of good keyframes from tiepoints, with the arguments and files of VICAR's keyframe_selection."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from xalign_ros.core.errors import FormatError
from xalign_ros.core.keyframes import overall, scores, sequential
from xalign_ros.core.tie_graph import connectivity
from xalign_ros.core.tie_selection import active
from xalign_ros.io.keyframe_parameters import KeyframeOptions
from xalign_ros.io.tae import image_numbers
from xalign_ros.io.text_files import write_text
from xalign_ros.io.vicar_list import read_image_list, write_image_list
from xalign_ros.io.vicar_matrix import TITLE, matrix_lines
from xalign_ros.io.vicar_ties import read_ties
from xalign_ros.io.vicar_views import placed, read_views, search_path

USAGE = "usage: xalign keyframes inp=LIST out=KEYFRAMES.lis in_tpt=TIES.tpt [NAME=VALUE | -KEYWORD | --flag] ..."
ABOUT = "The images that make good keyframes by the geometry of their ties, as a list. docs/vicar.md has the score."
OPTIONS = KeyframeOptions


def run(options: KeyframeOptions) -> None:
    """Raises XalignError on bad input."""
    names, lines = keyframes(options, lambda text: print(text, file=sys.stderr))
    print("".join(lines) + f"{len(names)} keyframes written to {options.out}")


def keyframes(options: KeyframeOptions, say: Callable[[str], None] = lambda _: None) -> tuple[list[str], list[str]]:
    """Names of the keyframes, which are written to OUT, and what the command prints. Raises XalignError."""
    for name in options.without_effect():
        say(f"{name} has no effect")
    names = read_image_list(options.inp)
    n = len(names)
    views = read_views(names, None, None, search_path(options.config_path), say).views
    references: Sequence[int] = ()
    if options.refimage not in ((), (-1,)):
        references = image_numbers("REFIMAGE", options.refimage, n)
        references = range(options.refimage[0]) if options.until else references
    ignored = image_numbers("IGNORE", options.ignore, n)
    ties = placed(read_ties(options.in_tpt), views, options.in_tpt, say)
    ties = active(ties, n, ignored, references, options.ignore_intra)[0]
    ties = ties.take(ties.of_two)
    if not len(ties):
        raise FormatError(f"{options.in_tpt} has no tie that is used")
    score = scores(views, ties, options.edge_dist)
    chosen = sequential(score) if options.sequential else overall(score, options.sel_percent)
    if len(chosen) < 2:
        raise FormatError(f"{options.in_tpt} gives {len(chosen)} keyframes, fewer than two: selection failed")
    info = [*matrix_lines("Scores (per pair):", score.round(4))], [*matrix_lines(TITLE, connectivity(ties, n))]
    write_text(Path(f"{options.out}.info"), [*info[0], *info[1]])
    keyframe_names = [names[i] for i in chosen]
    write_image_list(options.out, keyframe_names)
    return keyframe_names, [*(info[1] if options.disp_connect else []), *(info[0] if options.disp_cost else [])]
