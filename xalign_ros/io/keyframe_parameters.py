"""The parameters of `xalign keyframes`: those of VICAR's keyframe_selection."""

from __future__ import annotations

from dataclasses import dataclass, fields

from xalign_ros.io.tae import UsageError, parameter
from xalign_ros.io.vicar_parameters import IGNORED, WITHOUT_EFFECT


@dataclass(frozen=True, slots=True)
class KeyframeOptions:
    inp: tuple[str, ...] = parameter("The images, or one file that lists them, a name a line.", many=2000)
    out: str = parameter("The list of keyframes that is written, an INP again; OUT.info has the scores.")
    in_tpt: str = parameter("The tiepoints, XML or old text.")
    refimage: tuple[int, ...] = parameter("Reference images, of IGNORE_INTRA.", (), many=200)
    until: bool = parameter("All images up to REFIMAGE(1) are references.", False, keywords=("UNTIL", "NULL"))
    ignore: tuple[int, ...] = parameter(
        "Images whose ties are not used, counted from 1; -N ends a range.", (), many=200
    )
    ignore_intra: bool = parameter(
        "Use only ties between a reference and another image.", False, keywords=("IGNORE_INTRA", "NOIGNORE_INTRA")
    )
    start_key: int = parameter(IGNORED, 0)
    omp_on: bool = parameter(IGNORED, True, keywords=("OMP_ON", "OMP_OFF"))
    config_path: str = parameter("Folders where camera models are looked for, too.", "$MARS_CONFIG_PATH")
    point_method: str | None = parameter(IGNORED, None)
    rsf: tuple[str, ...] = parameter(IGNORED, (), many=100)
    debug_rsf: bool = parameter(IGNORED, False, keywords=("DEBUG_RSF", "NODEBUG_RSF"))
    coord: str = parameter(IGNORED, "FIXED", keywords=("FIXED", "INSTRUMENT", "SITE", "ROVER", "LOCAL_LEVEL"))
    coord_index: tuple[int, ...] = parameter(IGNORED, (), many=10)
    fixed_site: int | None = parameter(IGNORED, None)
    disp_connect: bool = parameter("Print the connectivity.", True, keywords=("DISP_CONNECT", "NODISP_CONNECT"))
    disp_cost: bool = parameter("Print the scores.", True, keywords=("DISP_COST", "NODISP_COST"))
    edge_dist: float = parameter("Part of the image at each border whose ties are not used.", 0.05)
    sequential: bool = parameter(
        "Follow the order of the images; without it the best SEL_PERCENT.",
        True,
        keywords=("SEQUENTIAL", "NOSEQUENTIAL"),
    )
    sel_percent: float = parameter("Part of the images that NOSEQUENTIAL takes at most, in percent.", 80.0)

    def check(self) -> None:
        """Raises UsageError on values that do not go together."""
        if not 0 <= self.edge_dist < 0.5:
            raise UsageError(f"EDGE_DIST={self.edge_dist} is not within 0 and 0.5")
        if not 0 < self.sel_percent <= 100:
            raise UsageError(f"SEL_PERCENT={self.sel_percent} is not within 0 and 100")
        if self.until and not (self.refimage and self.refimage[0] > 0):
            raise UsageError("UNTIL needs REFIMAGE, a positive number")
        if self.ignore_intra and (not self.refimage or self.refimage == (-1,)):
            raise UsageError("IGNORE_INTRA needs REFIMAGE")

    def without_effect(self) -> list[str]:
        """Parameters that were given and do nothing."""
        default = {f.name: f.default for f in fields(self)}
        return [name.upper() for name in WITHOUT_EFFECT if getattr(self, name) != default[name]]
