"""The rule between folders, read from the source: apps -> io -> core, and what each may touch."""

import ast
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "xalign_ros"
FILES = sorted(p.relative_to(PACKAGE) for p in PACKAGE.rglob("*.py"))
TREES = {path: ast.parse((PACKAGE / path).read_text(encoding="utf-8"), str(path)) for path in FILES}
CORE = [p for p in FILES if p.parts[0] == "core"]

GRAPH = ("window.py", "gtsam_bridge.py")  # and core/graph*.py
ANCHORS = ("extraction.py", "pnp.py", "descriptors.py", "track_odometry.py", "window_lock.py", "epipolar.py")
FINDERS = {"cv2", "poselib", "pycolmap", "pytheia", "faiss"}
ROS = {"rclpy", "xalign_msgs", "std_msgs", "geometry_msgs", "sensor_msgs", "nav_msgs", "tf2_ros", "rosidl_runtime_py"}
# What makes the same input give other numbers, or speaks to the world.
WORLDLY = {
    "os",
    "pathlib",
    "io",
    "shutil",
    "tempfile",
    "glob",
    "subprocess",
    "socket",
    "time",
    "datetime",
    "threading",
    "multiprocessing",
    "concurrent",
    "asyncio",
    "queue",
    "logging",
    "warnings",
    "random",
    "secrets",
    "uuid",
    "sys",
    "pickle",
    "importlib",
}
# Longer than 300 lines, each with the reason why it is not two files: {"io/x.py": "one format, which ..."}.
LONG: dict[str, str] = {}


def module_of(path):
    parts = ("xalign_ros", *path.with_suffix("").parts)
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imports(path, *, lazy=True):
    """Modules that a file imports (full names; of `from a import b` both a and a.b), those within functions if lazy."""
    found = set()
    body = list(ast.walk(TREES[path]))
    if not lazy:
        inner = {id(n) for f in body if isinstance(f, ast.FunctionDef | ast.AsyncFunctionDef) for n in ast.walk(f)}
        body = [n for n in body if id(n) not in inner]
    for node in body:
        if isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                here = module_of(path).split(".")
                parents = here if path.name == "__init__.py" else here[:-1]
                base = ".".join([*parents[: len(parents) - node.level + 1], *([base] if base else [])])
            found.add(base)
            found.update(f"{base}.{alias.name}" for alias in node.names)
    return found


def folder_imports(path, folder, *, lazy=True):
    """Modules of one of our folders that a file imports."""
    prefix = f"xalign_ros.{folder}"
    return {m for m in imports(path, lazy=lazy) if m == prefix or m.startswith(prefix + ".")}


def roots(path):
    return {m.split(".")[0] for m in imports(path)}


def called(path):
    """Names that a file calls: `f` of f(), `a.b.c` of a.b.c()."""
    return {ast.unparse(n.func) for n in ast.walk(TREES[path]) if isinstance(n, ast.Call)}


def offenders(paths, of):
    return {str(p): sorted(found) for p in paths if (found := of(p))}


def test_the_folders_are_those_of_the_design():
    assert {p.parts[0] for p in FILES if len(p.parts) > 1} == {"core", "io", "apps", "compat"}
    assert {p.name for p in FILES if len(p.parts) == 1} <= {"__init__.py", "__main__.py"}


def test_core_knows_neither_io_nor_apps():
    assert not offenders(CORE, lambda p: folder_imports(p, "io") | folder_imports(p, "apps"))


def test_compat_knows_the_core_alone_and_nobody_knows_compat():
    def wrong(path):
        if path.parts[0] == "compat":
            return folder_imports(path, "io") | folder_imports(path, "apps")
        return folder_imports(path, "compat")

    assert not offenders(FILES, wrong)


def test_io_does_not_know_apps():
    assert not offenders([p for p in FILES if p.parts[0] == "io"], lambda p: folder_imports(p, "apps"))


def test_apps_do_not_import_each_other():
    """But for main, which imports the subcommand that was asked for, when it was; `node_x.py` is a part of `node.py`.

    Parts of the node may know each other."""

    def strangers(path):
        found = {".".join(m.split(".")[:3]) for m in folder_imports(path, "apps", lazy=path.name != "main.py")}
        parts = {m for m in found if m.startswith(f"{module_of(path)}_")}
        if path.name.startswith("node_"):
            parts = {m for m in found if m.startswith("xalign_ros.apps.node_")}
        return found - parts - {module_of(path), "xalign_ros.apps"}

    assert not offenders([p for p in FILES if p.parts[0] == "apps"], strangers)


def test_core_is_without_files_clocks_threads_and_chance():
    assert not offenders(CORE, lambda p: roots(p) & (WORLDLY | ROS))


def test_core_neither_prints_nor_opens():
    assert not offenders(CORE, lambda p: called(p) & {"print", "open", "input", "exec", "eval", "breakpoint"})
    files = {"np.load", "np.save", "np.savez", "np.loadtxt", "np.savetxt", "np.fromfile", "np.memmap", "cv2.imread"}
    assert not offenders(CORE, lambda p: called(p) & files)


def test_core_draws_nothing_from_global_random_state():
    """np.random.default_rng(seed) with a seed, and nothing else of np.random; nothing seeds OpenCV."""

    def found(path):
        bad = {
            c for c in called(path) if c.startswith(("np.random.", "numpy.random.")) and not c.endswith("default_rng")
        }
        for node in ast.walk(TREES[path]):
            if isinstance(node, ast.Call) and ast.unparse(node.func).endswith("default_rng") and not node.args:
                bad.add("default_rng()")
        return bad | (called(path) & {"cv2.setRNGSeed", "hash"})  # hash() of text differs from process to process

    assert not offenders(CORE, found)


def test_core_keeps_no_global_state():
    """No `global`, and no module-level list, dict or set that is not written in capitals (and so promised constant)."""

    def found(path):
        bad = {f"global {', '.join(n.names)}" for n in ast.walk(TREES[path]) if isinstance(n, ast.Global)}
        for node in TREES[path].body:
            if isinstance(node, ast.Assign) and isinstance(node.value, ast.List | ast.Dict | ast.Set | ast.ListComp):
                bad.update(t.id for t in node.targets if isinstance(t, ast.Name) and not t.id.isupper())
        return bad

    assert not offenders(CORE, found)


def test_gtsam_is_met_in_the_graph_files_alone():
    def allowed(path):
        return path.parts[0] == "core" and (path.name in GRAPH or path.name.startswith("graph"))

    assert not offenders([p for p in FILES if not allowed(p)], lambda p: roots(p) & {"gtsam", "gtsam_unstable"})


def test_vision_libraries_are_met_where_anchors_are_found():
    allowed = {Path("core") / name for name in ANCHORS}
    assert not offenders([p for p in CORE if p not in allowed], lambda p: roots(p) & FINDERS)


def test_ros_is_met_in_the_node_and_the_player_alone():
    def allowed(path):
        return path.parts[0] == "apps" and (path.stem in ("node", "player") or path.stem.startswith("node_"))

    assert not offenders([p for p in FILES if not allowed(p)], lambda p: roots(p) & ROS)


def test_nothing_is_pickled():
    assert not offenders(FILES, lambda p: roots(p) & {"pickle", "dill", "cloudpickle", "shelve", "marshal"})


def test_names_say_what_is_inside():
    vague = {"utils", "util", "common", "helpers", "helper", "manager", "misc", "tools"}
    assert not [p for p in FILES if p.stem in vague or any(part in vague for part in p.parts)]


def test_files_are_short():
    """Over 300 lines a file asks to be split by noun; those that may not be are listed with their reason, and no others."""
    lengths = {p.as_posix(): (PACKAGE / p).read_text(encoding="utf-8").count("\n") for p in FILES}
    assert {name: n for name, n in lengths.items() if n > 300 and name not in LONG} == {}
    assert [name for name in LONG if lengths.get(name, 0) <= 300] == []


def test_every_file_says_what_it_is():
    assert not [str(p) for p in FILES if not ast.get_docstring(TREES[p])]


@pytest.mark.parametrize("path", CORE, ids=str)
def test_core_can_be_imported_without_ros(path):
    """Transitively: no module of the core reaches ROS or io through another."""
    seen, todo = set(), {path}
    while todo:
        at = todo.pop()
        seen.add(at)
        for m in imports(at):
            near = Path(*m.split(".")[1:]).with_suffix(".py") if m.startswith("xalign_ros.") else None
            if near in TREES and near not in seen:
                todo.add(near)
    assert {p.parts[0] for p in seen} == {"core"}
    assert not set().union(*(roots(p) for p in seen)) & ROS


def test_the_rules_catch_what_they_are_for(monkeypatch):
    """A file that breaks them all is caught by each."""
    path = Path("core/bad.py")
    code = """
import os, gtsam, cv2, rclpy, random
from ..io import log
from xalign_ros.apps.node import main
state = {}
def f():
    global state
    print(open("x"), np.random.rand(3), np.random.default_rng(), hash("a"))
"""
    monkeypatch.setitem(TREES, path, ast.parse(code))
    here = sys.modules[__name__]
    monkeypatch.setattr(here, "FILES", [*FILES, path])
    monkeypatch.setattr(here, "CORE", [*CORE, path])
    for rule in (
        test_core_knows_neither_io_nor_apps,
        test_core_is_without_files_clocks_threads_and_chance,
        test_core_neither_prints_nor_opens,
        test_core_draws_nothing_from_global_random_state,
        test_core_keeps_no_global_state,
        test_gtsam_is_met_in_the_graph_files_alone,
        test_vision_libraries_are_met_where_anchors_are_found,
        test_ros_is_met_in_the_node_and_the_player_alone,
        test_every_file_says_what_it_is,
    ):
        with pytest.raises(AssertionError):
            rule()
