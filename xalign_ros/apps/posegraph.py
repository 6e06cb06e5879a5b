"""xalign posegraph: poses of images from tiepoints and telemetry, with the arguments and files of VICAR's POSEGRAPH."""

from __future__ import annotations

import json
import sys

from xalign_ros.apps.posegraph_run import posegraph
from xalign_ros.io.vicar_log import as_json, log_lines
from xalign_ros.io.vicar_parameters import Options

USAGE = (
    "usage: xalign posegraph inp=LIST out=OUT.nav out_g2o=OUT.g2o in_tpt=TIES.tpt [NAME=VALUE | -KEYWORD | --flag] ..."
)
ABOUT = (
    "Poses of images from the tiepoints between them and their telemetry. Names are taken in any case and may be cut "
    "while they stay clear; --out-g2o OUT.g2o, --use-essential and --no-use-essential are understood, too; lists are "
    "(a,b,c). docs/vicar.md tells what differs from VICAR's own program."
)
OPTIONS = Options


def run(options: Options) -> None:
    """Raises XalignError on bad input."""
    result = posegraph(options, lambda text: print(text, file=sys.stderr))
    out = sys.stderr if options.json else sys.stdout
    for line in log_lines(options, result):
        print(line, file=out)
    if options.json:
        print(json.dumps(as_json(result)))
