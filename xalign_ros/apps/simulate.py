"""xalign simulate: a world that does not exist, as a map, a log and the truth."""

from __future__ import annotations

import argparse
import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from xalign_ros.core.config import Config
from xalign_ros.core.errors import ConfigError, FormatError
from xalign_ros.core.faults import FAULTS, Arrivals, faulty, faulty_map
from xalign_ros.core.map_building import build_map
from xalign_ros.core.simulation import WORLDS, driving, mapping, world
from xalign_ros.core.transforms import SE3
from xalign_ros.io.log import LogWriter, typestore
from xalign_ros.io.messages import KEYFRAME, keyframe_message
from xalign_ros.io.progress_bar import progress_bar
from xalign_ros.io.tum import Trajectory, write_tum
from xalign_ros.io.xmap import write_map

FEWEST = 10


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="DIR", help="folder for the files; new")
    parser.add_argument("--world", choices=WORLDS, default="corridor", help="default corridor")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="same seed, same bytes; default 0")
    parser.add_argument("--keyframes", type=int, default=300, metavar="N", help="of the run, 0.4 m apart; default 300")
    parser.add_argument(
        "--fault", choices=FAULTS, metavar="NAME", help=f"what goes wrong with the run or its map: {', '.join(FAULTS)}"
    )
    parser.add_argument("--metric", action="store_true", help="an odometry in metres, as VIO's")


def run(args: argparse.Namespace) -> None:
    """DIR/map.xmap, DIR/run.mcap, DIR/truth.tum (T_map_cam), DIR/mapping.mcap and .tum that the map was built of."""
    if args.seed < 0 or args.keyframes < FEWEST:
        raise ConfigError(f"--seed must not be negative and --keyframes at least {FEWEST}")
    if args.output.exists():
        raise FormatError(f"{args.output} exists; name a new folder")
    built = world(args.world, args.seed, args.keyframes)
    posed = mapping(built, args.seed)
    source = f"xalign simulate --world {args.world} --seed {args.seed}"
    map_ = build_map(posed, built.mapped, map_id=args.world, source=source, metric=True, progress=progress_bar)
    map_ = faulty_map(map_, args.fault, args.seed) if args.fault else map_
    drive = driving(built, args.seed, Config().odometry, metric=args.metric)
    arrivals = faulty(drive, args.fault, args.seed) if args.fault else [(k.stamp_ns, k) for k in drive]
    args.output.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=args.output.parent, prefix=f".{args.output.name}.") as temporary:
        folder = Path(temporary) / "d"
        folder.mkdir()
        write_map(map_, folder / "map.xmap")
        _write(folder / "mapping.mcap", folder / "mapping.tum", [(k.stamp_ns, k) for k in posed], built.mapped)
        _write(folder / "run.mcap", folder / "truth.tum", arrivals, built.driven)
        shutil.move(folder, args.output)
    print(f"{args.output}: map of {len(map_.points)} points, run of {len(drive)} keyframes")


def _write(log: Path, poses: Path, arrivals: Arrivals, truth: Sequence[SE3]) -> None:
    """The keyframes as they come, and the truth (of keyframe k at k) at the stamps that they tell."""
    types = typestore().types.__getitem__
    with LogWriter(log) as writer:
        for arrival_ns, keyframe in arrivals:
            writer.write("keyframes", KEYFRAME, keyframe_message(types, keyframe), arrival_ns)
    true = {k.stamp_ns: truth[k.id] for _, k in arrivals}
    stamps = sorted(true)
    R, t = (np.array([getattr(true[stamp], part) for stamp in stamps]) for part in ("R", "t"))
    write_tum(poses, Trajectory(np.array(stamps), R, t))
