"""The parameters of `xalign posegraph`: the 31 of VICAR's POSEGRAPH, and ours."""

from __future__ import annotations

from dataclasses import dataclass, fields

from xalign_ros.core.pose_graph import LOSSES, Loss
from xalign_ros.io.tae import UsageError, parameter

SOLVERS = "DENSE_NORMAL_CHOLESKY DENSE_QR DENSE_SCHUR SPARSE_NORMAL_CHOLESKY SPARSE_SCHUR ITERATIVE_SCHUR CGNR".split()
WITHOUT_EFFECT = ("point_method", "rsf", "debug_rsf", "coord", "coord_index", "fixed_site")
IGNORED = "Taken and without effect, as in POSEGRAPH."
WIDTH = 3.0


@dataclass(frozen=True, slots=True)
class Options:
    inp: tuple[str, ...] = parameter("The images, or one file that lists them, a name a line.", many=2000)
    out: str = parameter("The navigation file that is written.")
    out_g2o: str = parameter(
        "The pose graph that is written: the images' poses as they came in, and the edges.", also="out_g20"
    )
    in_tpt: str = parameter("The tiepoints, XML or old text.")
    navtable: str | None = parameter("Navigation file with the images' pointing (telemetry), XML or text.", None)
    format: str = parameter("Format of OUT.", "XML", keywords=("XML", "TXT"))
    out_solution_id: str | None = parameter("Name of the solution in OUT; required with XML.", None)
    solution_id: str | None = parameter("Solution of NAVTABLE; without it that of highest priority.", None)
    solver: str = parameter(
        f"{', '.join(SOLVERS)}. All mean the one solver there is, which chooses a band or a sparse factor itself.",
        "DENSE_NORMAL_CHOLESKY",
    )
    summary: str = parameter("How much is said of the solve.", "FULL_SUM", keywords=("NO_SUM", "BRIEF_SUM", "FULL_SUM"))
    cm_ori: bool = parameter(
        "Write the camera models before the solve to OUT, too.", False, keywords=("CM_ORI", "NOCM_ORI")
    )
    refimage: tuple[int, ...] = parameter(
        "Images that are held where they are, counted from 1; -N after a number is a range up to N, -1 alone means none "
        "(then the first image of every connected part is held). Without it the image with most ties.",
        (),
        many=200,
    )
    until: bool = parameter("All images up to REFIMAGE(1) are held.", False, keywords=("UNTIL", "NULL"))
    ignore: tuple[int, ...] = parameter("Images whose ties are not used; ranges as in REFIMAGE.", (), many=200)
    ignore_intra: bool = parameter(
        "Use only ties between a held and another image.", False, keywords=("IGNORE_INTRA", "NOIGNORE_INTRA")
    )
    start_key: int = parameter("Key of the first image in OUT_TPT.", 0)
    omp_on: bool = parameter(
        "Pairs in parallel, on as many processors as there are or OMP_NUM_THREADS says; the numbers are the same.",
        True,
        keywords=("OMP_ON", "OMP_OFF"),
    )
    config_path: str = parameter(
        "Folders, between colons, where camera models are looked for that are not beside their images.",
        "$MARS_CONFIG_PATH",
    )
    point_method: str | None = parameter(IGNORED, None)
    rsf: tuple[str, ...] = parameter(IGNORED, (), many=100)
    debug_rsf: bool = parameter(IGNORED, False, keywords=("DEBUG_RSF", "NODEBUG_RSF"))
    coord: str = parameter(IGNORED, "FIXED", keywords=("FIXED", "INSTRUMENT", "SITE", "ROVER", "LOCAL_LEVEL"))
    coord_index: tuple[int, ...] = parameter(IGNORED, (), many=10)
    fixed_site: int | None = parameter(IGNORED, None)
    save_connect: bool = parameter("Write ./connectivity.txt.", True, keywords=("SAVE_CONNECT", "NOSAVE_CONNECT"))
    before_after: bool = parameter(
        "Write ./poses_original.txt and ./poses_optimized.txt and .g2o.",
        True,
        keywords=("BEFORE_AFTER", "NOBEFORE_AFTER"),
    )
    edge_dist: float = parameter("Part of the image at each border whose ties are not used.", 0.05)
    use_essential: bool = parameter(
        "Edges from the essential matrix of each pair; without it they repeat telemetry and add noise.",
        False,
        keywords=("USE_ESSENTIAL", "NOUSE_ESSENTIAL"),
    )
    max_rand_noise: float = parameter(
        "Without USE_ESSENTIAL: noise of the edges, as a part of the baseline and of 1 on each component of the "
        "quaternion; 0 adds none.",
        0.01,
    )
    max_quat_error: float = parameter(
        "An essential rotation is an edge while 1 - |w| of its quaternion to telemetry's is below this; 0.05 is 36 deg.",
        0.05,
    )
    max_pos_error: float = parameter(
        "An essential position is an edge while its distance to telemetry's is below this part of the baseline; "
        "0.1 is 5.7 deg.",
        0.1,
    )
    out_tpt: str | None = parameter("The ties that were used, in XML.", None)
    picture: str | None = parameter("The pose graph before and after, from above, as a PNG.", None)
    information: str = parameter(
        "What weighs the edges: their covariance, or the identity that POSEGRAPH writes.",
        "COVARIANCE",
        keywords=("COVARIANCE", "IDENTITY"),
    )
    weak_telemetry: bool = parameter(
        "With USE_ESSENTIAL: pairs with ties and without an edge keep a weak one from telemetry.",
        False,
        keywords=("WEAK_TELEMETRY", "NOWEAK_TELEMETRY"),
    )
    loss: str = parameter(
        f"Robust loss of the edges, {', '.join(LOSSES)}, and after a colon its width in standard deviations.",
        f"cauchy:{WIDTH:g}",
    )
    min_ties: int = parameter("Ties that a pair needs after the crop, at least 8.", 8)
    seed: int = parameter("Of the sampling and the noise; the same gives the same output.", 0)
    json: bool = parameter("Print one JSON object instead of the log.", False, keywords=("JSON", "NOJSON"))

    def check(self) -> None:
        """Raises UsageError on values that do not go together."""
        if self.format == "XML" and not self.out_solution_id:
            raise UsageError("OUT_SOLUTION_ID is required where FORMAT is XML")
        if self.solver.upper() not in SOLVERS:
            raise UsageError(f"there is no SOLVER {self.solver}, only {', '.join(SOLVERS)}")
        for name, low, high in (
            ("edge_dist", 0.0, 0.5),
            ("max_rand_noise", 0.0, 10.0),
            ("max_quat_error", 0.0, 1.0),
            ("max_pos_error", 0.0, 1e6),
            ("min_ties", 8, 1e9),
            ("seed", 0, 2**31 - 1),
            ("start_key", 0, 2**31 - 1),
        ):
            if not low <= getattr(self, name) <= high:
                raise UsageError(f"{name.upper()}={getattr(self, name)} is not within {low:g} and {high:g}")
        if self.until and not (self.refimage and self.refimage[0] > 0):
            raise UsageError("UNTIL needs REFIMAGE, a positive number")
        if self.ignore_intra and (not self.refimage or self.refimage == (-1,)):
            raise UsageError("IGNORE_INTRA needs REFIMAGE: it keeps ties between a held and another image")
        self.robust()

    def robust(self) -> Loss:
        """Raises UsageError."""
        name, _, width = self.loss.partition(":")
        try:
            return Loss(name.lower(), float(width) if width else WIDTH)
        except ValueError as error:
            raise UsageError(f"LOSS={self.loss}: {error}") from None

    def without_effect(self) -> list[str]:
        """Parameters that were given and do nothing."""
        default = {f.name: f.default for f in fields(self)}
        return [name.upper() for name in WITHOUT_EFFECT if getattr(self, name) != default[name]]
