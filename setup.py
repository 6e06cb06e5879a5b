"""The one home of the package's metadata, for colcon (ament_python) and for pip alike."""

from glob import glob

from pybind11.setup_helpers import Pybind11Extension
from setuptools import find_packages, setup

NAME = "xalign_ros"
SHARE = f"share/{NAME}"

setup(
    name=NAME,
    version="0.1.0",
    description="Keyframe in, correction out: aligns a run's odometry with a reference map, scale included.",
    license="Apache-2.0",
    author="xalign developers",
    maintainer="xalign developers",
    maintainer_email="xalign@example.org",
    python_requires=">=3.11",
    packages=find_packages(include=[NAME, f"{NAME}.*"]),
    ext_modules=[
        Pybind11Extension(
            f"{NAME}.core.kernels",
            ["src/kernels.cpp"],
            depends=sorted(glob("src/*.hpp")),
            cxx_std=17,
            # A product and a sum must not be made one where the processor can: the same bits everywhere.
            extra_compile_args=["-O3", "-ffp-contract=off", "-fno-math-errno"],
        )
    ],
    package_data={f"{NAME}.core": ["kernels.pyi"]},
    data_files=[
        # The marker by which ament finds the package; kept inside the package, so the tree has no top-level resource/.
        ("share/ament_index/resource_index/packages", [f"{NAME}/resource/{NAME}"]),
        (SHARE, ["package.xml"]),
        (f"{SHARE}/config", sorted(glob("config/*"))),
        # The message texts for ROS-free replay (io/msgdefs.py). Not share/xalign_msgs: the compiled package owns that.
        (f"{SHARE}/msg", sorted(glob("msg_defs/msg/*.msg"))),
    ],
    # In place of a setup.cfg: colcon puts executables where `ros2 run` looks; pip and uv keep to bin/.
    options={
        "develop": {"script_dir": f"$base/lib/{NAME}"},
        "install": {"install_scripts": f"$base/lib/{NAME}"},
    },
    # Only what colcon resolves. On a ROS distribution the rest comes from package.xml, elsewhere from the extras.
    install_requires=["setuptools"],
    extras_require={
        # ROS 2 (kilted) itself, for machines without a ROS distribution.
        "wheels": [
            "ros-rclpy==9.1.2",
            "ros-rmw-fastrtps-cpp==9.3.3",
            "ros-std-msgs==5.5.1",
            "ros-geometry-msgs==5.5.1",
            "ros-nav-msgs==5.5.1",
            "ros-sensor-msgs==5.5.1",
            "ros-visualization-msgs==5.5.1",
            "ros-diagnostic-msgs==5.5.1",
            "ros-std-srvs==5.5.1",
        ],
        # Exact where another version gives other numbers or bytes.
        "algo": [
            "numpy==2.4.6",  # the newest that Python 3.11 has, too
            "scipy>=1.14,<2",
            "gtsam==4.3.0",
            "poselib==2.0.5",
            "opencv-contrib-python-headless==5.0.0.93",  # AKAZE has moved there
            "h5py>=3.11,<4",
            "rich>=13.7,<16",
            "mcap>=1.3,<2",
            "zstandard>=0.22,<1",
            "isal>=1.7,<2",  # the checksums of MCAP in a sixth of the time that zlib takes
            "lz4>=4,<5",  # mcap and rosbags bring it anyway
            "rosbags==0.11.9",
            "matplotlib>=3.9,<4",
            "pyyaml>=6,<7",
            "pillow>=10",  # sizes of images; matplotlib needs it anyway
        ],
        # Many logs at once: processes of this machine, or a cluster.
        "batch": ["dask>=2025.1,<2027", "distributed>=2025.1,<2027"],
        # Exact where another version formats or complains differently. The name `test` makes colcon test use pytest.
        "test": [
            "pytest>=8.3,<10",
            "pytest-xdist>=3.6,<4",  # tests of nodes wait most of their time
            "hypothesis>=6.100,<7",
            "pycolmap==4.2.1",
            "ruff==0.17.6",
            "mypy==2.4.1",
            "pre-commit>=4,<5",
            "types-PyYAML>=6.0.12,<7",
            "setuptools>=75,<81",  # builds wheels by itself
            "pybind11>=2.13,<4",
        ],
    },
    entry_points={
        "console_scripts": [
            "xalign = xalign_ros.apps.main:main",
            "xalign_node = xalign_ros.apps.node:main",
        ],
    },
)
