"""Build of eskf_ros, for colcon (ament_python) and for plain pip alike."""

import importlib.util
import os
import subprocess
import sys
from glob import glob
from pathlib import Path

from setuptools import find_packages, setup
from setuptools.command.build_py import build_py

package_name = "eskf_ros"


class BuildWithMachineCode(build_py):
    """Compiles the estimator for the processor it is built on, so that its first start finds machine code.

    Without numba, on another processor later, or with ESKF_ROS_COMPILE=0 the first start compiles, in a minute.
    """

    def run(self):
        super().run()
        missing = [name for name in ("numba", "numpy", "scipy") if importlib.util.find_spec(name) is None]
        if getattr(self, "editable_mode", False) or os.environ.get("ESKF_ROS_COMPILE") == "0":
            return
        if missing:
            print(f"{package_name}: not compiled, {', '.join(missing)} missing here: the first start will do it")
            return
        library = Path(self.build_lib).resolve()
        paths = os.pathsep.join(filter(None, [str(library), os.environ.get("PYTHONPATH")]))
        environment = {
            **os.environ,
            "PYTHONPATH": paths,
            "NUMBA_CACHE_DIR": str(library / package_name / "machine_code"),
        }
        command = [sys.executable, "-m", f"{package_name}.ros_node.main", "--compile"]
        if subprocess.run(command, env=environment, cwd=library, check=False).returncode:
            print(f"{package_name}: not compiled (see above): the first start will do it")


setup(
    name=package_name,
    version="1.0.0",
    description="Error-state Kalman filter fusing an IMU with GNSS: ROS 2 navigation and replay of recordings",
    long_description=Path("README.md").read_text(encoding="utf-8"),
    long_description_content_type="text/markdown",
    url="https://github.com/eskf-ros/eskf_ros",
    project_urls={"Bug tracker": "https://github.com/eskf-ros/eskf_ros/issues"},
    author="eskf_ros maintainers",
    author_email="eskf-ros@users.noreply.github.com",
    maintainer="eskf_ros maintainers",
    maintainer_email="eskf-ros@users.noreply.github.com",
    license="Apache-2.0",
    classifiers=[
        "Development Status :: 5 - Production/Stable",
        "Intended Audience :: Science/Research",
        "Operating System :: POSIX :: Linux",
        "Programming Language :: Python :: 3",
        "Topic :: Scientific/Engineering",
    ],
    cmdclass={"build_py": BuildWithMachineCode},
    packages=find_packages(include=[package_name, f"{package_name}.*"]),
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{package_name}"]),
        (f"share/{package_name}", ["package.xml"]),
        (f"share/{package_name}/config", sorted(glob("config/*.yaml"))),
        (f"share/{package_name}/config/nav2", sorted(glob("config/nav2/*.yaml"))),
        (f"share/{package_name}/config/views", sorted(glob("config/views/*"))),
        (f"share/{package_name}/config/profiles", sorted(glob("config/profiles/*.yaml"))),
        (f"share/{package_name}/bags", sorted(glob("bags/*.mcap") + glob("bags/*.nav"))),
        (f"share/{package_name}/launch", sorted(glob("launch/*.launch.py"))),
    ],
    python_requires=">=3.10",
    install_requires=[
        "numpy>=1.26",
        "scipy>=1.11",
        "numba>=0.58",
        "pyyaml",
        "rosbags",
        "ruamel.yaml",
        "mcap",
        "lz4",
        "zstandard",
        "rich",
    ],
    extras_require={
        # Jazzy from PyPI: Linux on x86-64 only. Elsewhere, or beside /opt/ros, use the ROS installation instead.
        "ros": [
            "ros-jazzy-rclpy; sys_platform == 'linux' and platform_machine == 'x86_64'",
            "ros-jazzy-common-interfaces; sys_platform == 'linux' and platform_machine == 'x86_64'",
            "ros-rclpy[fastrtps]==7.1.6; sys_platform == 'linux' and platform_machine == 'x86_64'",
        ],
        # The World Magnetic Model, for the declination that a magnetometer needs; MIT, 0.3 MB, without dependencies.
        "mag": ["pygeomag"],
        # The page of eskf_report, on the computer where results are looked at: BSD, draws without a network.
        "report": ["bokeh>=3.4"],
        # Fleets of recordings on a Dask cluster (--dask); processes of one machine (--jobs) need nothing.
        "dask": ["distributed"],
        # eskf_calibrate --static: the Allan deviation, and its plot; LGPL-3.0, pure Python.
        "calibrate": ["allantools", "matplotlib"],
        "test": [
            "allantools",
            "bokeh>=3.4",
            "distributed",
            "gtsam",
            "hypothesis",
            "matplotlib",  # examples/compare_configurations.py and examples/lessons draw
            "mypy",
            "pygeomag",
            "pymap3d",
            # Independent GNSS libraries, wheels for Linux on x86-64; without them these comparisons are skipped.
            "pyrtklib5; sys_platform == 'linux' and platform_machine == 'x86_64' and python_version < '3.13'",
            "pytest",
            "pytest-xdist",  # `./run test` runs the files of tests on two processes
            "ruff",
            "setuptools>=70.1",  # makes wheels without the package wheel
            "sidereon; sys_platform == 'linux' and platform_machine == 'x86_64'",
        ],
        # The documents as a site (.ci/docs); docs/developing.md says why Sphinx.
        "docs": ["furo", "myst-parser>=4", "sphinx>=8", "sphinxcontrib-mermaid"],
        # The pictures of examples/lessons: small PNG files that a page of Markdown shows, which Bokeh does not make.
        "lessons": ["matplotlib"],
        # Beside [test]: the benchmarks that draw figures, and the one that compares with other filters.
        "benchmark": ["evo", "matplotlib"],
    },
    entry_points={
        "console_scripts": [
            "eskf_node = eskf_ros.ros_node.main:main",
            "eskf_replay = eskf_ros.replay.main:main",
            "eskf_report = eskf_ros.report.main:main",
            "eskf_check = eskf_ros.doctor.main:main",
            "eskf_calibrate = eskf_ros.calibration.main:main",
            "eskf_ranges = eskf_ros.inputs.ranges_command:main",
            "eskf_simulate = eskf_ros.simulate.main:main",
            "eskf_watch = eskf_ros.watch.main:main",
            "eskf_migrate = eskf_ros.migrate.main:main",
        ],
    },
    zip_safe=True,
)
