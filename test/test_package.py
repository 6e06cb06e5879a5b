"""The package as others get it: messages, wheel, launch and parameter files, declared dependencies."""

import ast
import dataclasses
import importlib.util
import json
import os
import py_compile
import re
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from importlib.metadata import entry_points, requires, version
from pathlib import Path

import numpy as np
import pytest
import yaml
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

import xalign_ros
from xalign_ros.io.log import LogWriter
from xalign_ros.io.msgdefs import message_definitions

ROOT = Path(__file__).parents[1]

# The wire contract: another hash is another message, and recorded logs and running peers no longer match.
HASHES = {
    "AlignmentState": "RIHS01_39dca88b162bb69ff198c552d0e8ebb3ccdc72867efb284fe0df4b79f7c0ec69",
    "Anchor": "RIHS01_2a9d89af6db2399f5af83e5f4db1fd51911fdc502e71dcee92e654e14793ed5b",
    "Correction": "RIHS01_ef2b305af0dbbc0e2f37b9151703917b7665cc17500d376195b2a16db3f6cc00",
    "Features": "RIHS01_5910a174fe78065cb623c4a91590c69d3457bb52cb140bc52edfe23e2b4bc08a",
    "Jump": "RIHS01_297fd707e16c3b01cf77666380049d7f61d7ad820779a55472e769b47efedeb9",
    "Keyframe": "RIHS01_87252deb3d31ad43aa4be28eaf1936f1f7c8a39d556c9df568078f3a943acc65",
    "Sim3": "RIHS01_4dfdc08c4e5b32dfe5149849f8b8831ca0d28d6ac5b9931a2001df68703bf6e0",
}


@pytest.fixture(scope="module")
def store():
    found = get_typestore(Stores.ROS2_KILTED)
    for name, text in message_definitions().items():
        found.register(get_types_from_msg(text, name))
    return found


def compiled(name):
    return getattr(pytest.importorskip("xalign_msgs.msg"), name)


def fields(text):
    """(name, type as compiled classes spell it) of each field of a .msg text."""
    found = []
    for line in text.splitlines():
        code = line.partition("#")[0].split()
        if not code or "=" in line.partition("#")[0]:
            continue
        kind, name = code
        base, array, size = re.fullmatch(r"([\w/]+)(\[(\d*)\])?", kind).groups()
        base = {"bool": "boolean", "float32": "float", "float64": "double"}.get(base, base)
        if base[0].isupper():
            base = f"xalign_msgs/{base}"
        found.append((name, f"{base}[{size}]" if size else f"sequence<{base}>" if array else base))
    return found


def constants(text):
    return {name: int(value) for name, value in re.findall(r"^\w+ ([A-Z0-9_]+)\s*=\s*(\d+)", text, flags=re.MULTILINE)}


def values(message):
    """Field values, nested and comparable, of a message of either library."""
    if isinstance(message, str | bool | int):
        return message
    if hasattr(message, "get_fields_and_field_types"):
        return {name: values(getattr(message, name)) for name in message.get_fields_and_field_types()}
    if dataclasses.is_dataclass(message):
        # rosbags counts constants and its own __msgtype__ among the fields.
        names = (field.name for field in dataclasses.fields(message))
        return {name: values(getattr(message, name)) for name in names if name.islower() and name != "__msgtype__"}
    # repr: NaN equals NaN.
    return repr(np.asarray(message).tolist())


def from_ros(store, data, kind):
    # Not deserialize_cdr: rclpy's serialize_message may leave undefined bytes behind the message, and it refuses them.
    definition = store.get_msgdef(kind)
    message, _ = definition.deserialize_cdr_le(memoryview(data)[4:], 0, definition.cls, store)
    return message


def test_messages_are_those_of_the_contract(store):
    assert set(message_definitions()) == {f"xalign_msgs/msg/{name}" for name in HASHES}
    assert {name: store.hash_rihs01(f"xalign_msgs/msg/{name}") for name in HASHES} == HASHES


@pytest.mark.parametrize("name", HASHES)
def test_compiled_message_is_the_text(name):
    text = message_definitions()[f"xalign_msgs/msg/{name}"]
    message = compiled(name)
    assert list(message.get_fields_and_field_types().items()) == fields(text)
    assert {key: getattr(message, key) for key in constants(text)} == constants(text)


def test_stand_in_is_the_official_message(store):
    """As `ros2 topic info -v` shows it for /tf of a distribution."""
    store.register(
        get_types_from_msg((ROOT / "msg_defs/tf2_msgs/msg/TFMessage.msg").read_text(), "tf2_msgs/msg/TFMessage")
    )
    official = "RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087"
    assert store.hash_rihs01("tf2_msgs/msg/TFMessage") == official
    assert (ROOT / "msg_defs/tf2_msgs/COLCON_IGNORE").exists()


def test_every_message_text_is_compiled():
    cmake = (ROOT / "msg_defs/CMakeLists.txt").read_text()
    texts = [path.relative_to(ROOT / "msg_defs").as_posix() for path in ROOT.glob("msg_defs/*/*.[ms][sr][gv]")]
    assert sorted(re.findall(r'"((?:msg|srv)/\w+\.\w+)"', cmake)) == sorted(texts)


def filled_keyframe(store):
    """A Keyframe in rosbags' classes; lengths that leave padding, values that do not survive a detour over text."""
    kinds = store.types
    rng = np.random.default_rng(0)
    count = 3
    return kinds["xalign_msgs/msg/Keyframe"](
        header=kinds["std_msgs/msg/Header"](kinds["builtin_interfaces/msg/Time"](1_700_000_000, 999_999_999), "odom"),
        child_frame_id="cam",
        id=2**64 - 1,
        session=2**32 - 1,
        metric_scale=True,
        pose=kinds["geometry_msgs/msg/PoseWithCovariance"](
            kinds["geometry_msgs/msg/Pose"](
                kinds["geometry_msgs/msg/Point"](0.1, -2.0, 1e-300),
                kinds["geometry_msgs/msg/Quaternion"](0.5, -0.5, 0.5, 0.5),
            ),
            rng.normal(size=36),
        ),
        camera=kinds["sensor_msgs/msg/CameraInfo"](
            header=kinds["std_msgs/msg/Header"](kinds["builtin_interfaces/msg/Time"](0, 0), ""),
            height=480,
            width=640,
            distortion_model="fov",
            d=np.array([0.9]),
            k=rng.normal(size=9),
            r=np.eye(3).ravel(),
            p=np.zeros(12),
            binning_x=0,
            binning_y=0,
            roi=kinds["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False),
        ),
        features=kinds["xalign_msgs/msg/Features"](
            descriptor="freak",
            norm=kinds["xalign_msgs/msg/Features"].NORM_HAMMING,
            descriptor_bytes=7,
            uv=rng.uniform(0, 640, 2 * count).astype(np.float32),
            descriptors=rng.integers(0, 256, 7 * count, dtype=np.uint8),
            sigma_px=np.full(count, 0.1, np.float32),
            track_ids=np.array([0, 1, 2**64 - 1], np.uint64),
            xyz_cam=np.array([1, 2, 3, np.nan, np.nan, np.nan, 1e30, 0, -0.0], np.float32),
        ),
    )


def test_keyframe_round_trips_without_ros(store):
    keyframe = filled_keyframe(store)
    data = store.serialize_cdr(keyframe, "xalign_msgs/msg/Keyframe")
    assert values(store.deserialize_cdr(data, "xalign_msgs/msg/Keyframe")) == values(keyframe)


def test_keyframe_round_trips_through_ros(store):
    ros = pytest.importorskip("rclpy.serialization")
    keyframe = filled_keyframe(store)
    there = ros.deserialize_message(
        bytes(store.serialize_cdr(keyframe, "xalign_msgs/msg/Keyframe")), compiled("Keyframe")
    )
    assert values(there) == values(keyframe)
    # Values, not bytes: rclpy leaves the padding undefined.
    back = from_ros(store, ros.serialize_message(there), "xalign_msgs/msg/Keyframe")
    assert values(back) == values(keyframe)


@pytest.mark.parametrize("name", HASHES)
def test_message_written_by_ros_is_read_without(store, name):
    ros = pytest.importorskip("rclpy.serialization")
    message = compiled(name)()
    assert values(from_ros(store, ros.serialize_message(message), f"xalign_msgs/msg/{name}")) == values(message)


def test_wheel_brings_its_message_texts_and_commands(tmp_path):
    if not (importlib.util.find_spec("wheel") or importlib.util.find_spec("setuptools.command.bdist_wheel")):
        pytest.skip("setuptools cannot build wheels here")
    source = tmp_path / "source"
    for name in ("setup.py", "package.xml", "pyproject.toml", "xalign_ros", "src", "config", "msg_defs"):
        path = ROOT / name
        copy = shutil.copytree if path.is_dir() else shutil.copy
        source.mkdir(exist_ok=True)
        copy(path, source / name)

    def run(*command, cwd=tmp_path, **env):
        return subprocess.run(
            [sys.executable, *command], cwd=cwd, env=os.environ | env, check=True, capture_output=True, text=True
        ).stdout

    pip = ("-m", "pip", "--disable-pip-version-check")
    run(*pip, "wheel", "--no-deps", "--no-build-isolation", "-w", str(tmp_path), str(source))
    shutil.rmtree(source)
    (wheel,) = tmp_path.glob("xalign_ros-*.whl")
    prefix = tmp_path / "prefix"
    run(*pip, "install", "--ignore-installed", "--no-deps", "--no-index", "--prefix", str(prefix), str(wheel))

    (site,) = (path.parents[1] for path in prefix.rglob("xalign_ros/__init__.py"))
    ask = "import json, xalign_ros.io.msgdefs as m; print(json.dumps([m.__file__, m.message_definitions()]))"
    where, texts = json.loads(run("-c", ask, PYTHONPATH=str(site)))
    assert Path(where).is_relative_to(prefix)
    assert texts == message_definitions()
    (share,) = prefix.rglob("share/xalign_ros")
    assert {"config", "msg", "package.xml"} <= {path.name for path in share.iterdir()}
    assert (share / "config/xalign.launch.py").exists()
    assert (share.parent / "ament_index/resource_index/packages/xalign_ros").exists()
    assert {path.name for path in prefix.rglob("bin/*")} == {"xalign", "xalign_node"}


WITHOUT_TEXTS = {
    "eval": ["run.mcap", "truth.tum"],
    "map": ["build", "--log", "run.mcap", "--poses", "truth.tum", "-o", "m.xmap"],
}


@pytest.mark.parametrize("command", WITHOUT_TEXTS)
def test_a_package_without_its_message_texts_says_so(command, tmp_path):
    """A sound log is not called damaged for it."""
    topics = {"keyframes": "xalign_msgs/msg/Keyframe", "correction": "xalign_msgs/msg/Correction"}
    with LogWriter(tmp_path / "run.mcap") as log:
        for topic, name in topics.items():
            log.write_bytes(log.channel(topic, name), b"", 1)
    (tmp_path / "truth.tum").write_text("1 0 0 0 0 0 0 1\n2 1 0 0 0 0 0 1\n")
    shutil.copytree(ROOT / "xalign_ros", tmp_path / "bare" / "xalign_ros")
    done = subprocess.run(
        [sys.executable, "-m", "xalign_ros", command, *WITHOUT_TEXTS[command]],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(tmp_path / "bare")},
        capture_output=True,
        text=True,
    )
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (1, "", 1)
    assert "the message texts of xalign_msgs" in done.stderr and "pip install" in done.stderr


def test_launch_file_compiles(tmp_path):
    for path in ROOT.glob("config/*.launch.py"):
        py_compile.compile(str(path), cfile=str(tmp_path / "launch.pyc"), doraise=True)


def test_parameter_files_are_for_any_node_name():
    for path in ROOT.glob("config/*.yaml"):
        for node in yaml.safe_load(path.read_text()).values():
            assert list(node) == ["ros__parameters"], path


def test_versions_agree():
    texts = [ElementTree.parse(ROOT / path).findtext("version") for path in ("package.xml", "msg_defs/package.xml")]
    (messages,) = re.findall(r'^version = "(.*)"', (ROOT / "msg_defs/pyproject.toml").read_text(), flags=re.MULTILINE)
    assert {version("xalign_ros"), messages, *texts} == {xalign_ros.__version__}


def test_commands():
    commands = {e.name: e.value for e in entry_points(group="console_scripts") if e.name.startswith("xalign")}
    assert commands == {"xalign": "xalign_ros.apps.main:main", "xalign_node": "xalign_ros.apps.node:main"}


# Import name -> name in package.xml and of the pip distribution, where they differ. None: rosdep has no key.
ROSDEP = {
    name: None
    for name in ("gtsam", "poselib", "mcap", "zstandard", "lz4", "isal", "rosbags", "rich", "dask", "distributed")
} | {
    "PIL": "python3-pil",
    "cv2": "python3-opencv",
    "h5py": "python3-h5py",
    "matplotlib": "python3-matplotlib",
    "numpy": "python3-numpy",
    "scipy": "python3-scipy",
    "yaml": "python3-yaml",
}
DISTRIBUTION = {"PIL": "pillow", "cv2": "opencv-contrib-python-headless", "yaml": "pyyaml"}


def imports(paths):
    found = set()
    for path in paths:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                found.update(alias.name.partition(".")[0] for alias in node.names)
            elif isinstance(node, ast.ImportFrom) and not node.level:
                found.add(node.module.partition(".")[0])
    return found - set(sys.stdlib_module_names) - {"xalign_ros", "__future__"}


def test_what_the_code_imports_is_declared():
    used = imports([*ROOT.glob("xalign_ros/**/*.py"), *ROOT.glob("config/*.launch.py")])
    package = ElementTree.parse(ROOT / "package.xml").getroot()
    ros = {node.text for node in package if node.tag in ("depend", "exec_depend")}
    assert {ROSDEP.get(name, name) for name in used} - {None} <= ros

    pip = {
        re.split(r"[^\w-]", line)[0].lower()
        for line in requires("xalign_ros")
        if re.search(r"extra == .(algo|batch)", line)
    }
    assert {DISTRIBUTION.get(name, name) for name in used & set(ROSDEP)} <= pip


def test_message_package_declares_the_packages_its_fields_use():
    used = {kind.split("/")[0] for text in message_definitions().values() for _, kind in fields(text) if "/" in kind}
    used = {name.removeprefix("sequence<") for name in used} - {"xalign_msgs"}
    package = ElementTree.parse(ROOT / "msg_defs/package.xml").getroot()
    assert used == {node.text for node in package if node.tag == "depend"}
    (line,) = re.findall(r"DEPENDENCIES (.*)\)", (ROOT / "msg_defs/CMakeLists.txt").read_text())
    assert used == set(line.split())
