"""Builds the messages with CMakeLists.txt, as colcon does, and packs them with the Python code.

Everything else that describes the package stands in pyproject.toml.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import sysconfig
import tempfile
from pathlib import Path

from setuptools import Command, Distribution, setup
from setuptools.command.build import build

ROOT = Path(__file__).resolve().parent
BUILD_SUPPORT = ROOT / "build_support"
sys.path.insert(0, str(BUILD_SUPPORT))

from ros_prefix import generator_prefixes, sourced_prefixes  # noqa: E402  (stands in build_support/)

SITE_PACKAGES = os.path.relpath(sysconfig.get_path("platlib"), sysconfig.get_path("data"))
"""Where Python modules stand, from the environment's prefix."""
EDITABLE = "_relpose_ros_messages"
# Libraries find one another and those of ROS wherever the environment stands: from <prefix>/lib, and from
# relpose_ros/ in site-packages, in an editable installation one folder deeper.
RUNTIME_PATHS = "$ORIGIN:$ORIGIN/../../..:$ORIGIN/../../../.."


class PlatformDistribution(Distribution):
    """Its wheels are for one Python and one platform: they hold compiled type support."""

    def has_ext_modules(self) -> bool:
        """Whether there is compiled code."""
        return True


class Build(build):
    """The usual build, and the messages."""

    def initialize_options(self) -> None:
        """Build outside the checkout: modules deleted since the last build must not reach the next wheel."""
        super().initialize_options()
        self._scratch = tempfile.TemporaryDirectory(prefix="relpose_ros-")
        self.build_base = self._scratch.name

    sub_commands = [*build.sub_commands, ("build_messages", None)]  # noqa: RUF012  (setuptools' own type)


class BuildMessages(Command):
    """Runs CMakeLists.txt, and shares what it installs between the package and the prefix."""

    description = "generate and compile the ROS messages"
    user_options = []  # noqa: RUF012  (setuptools' own type)
    editable_mode = False

    def initialize_options(self) -> None:
        """Declare the options that the build command sets."""
        self.build_lib: str | None = None
        self.build_temp: str | None = None

    def finalize_options(self) -> None:
        """Take the folders from the build command."""
        self.set_undefined_options("build", ("build_lib", "build_lib"), ("build_temp", "build_temp"))

    def get_source_files(self) -> list[str]:
        """What a source distribution needs for this step."""
        files = [ROOT / "CMakeLists.txt", ROOT / "package.xml"]
        for folder in ("build_support", "config", "launch", "msg"):
            files += sorted(path for path in (ROOT / folder).glob("*") if path.is_file())
        return [str(path.relative_to(ROOT)) for path in files]

    def get_outputs(self) -> list[str]:
        """Nothing that an editable wheel would have to link."""
        return []

    def get_output_mapping(self) -> dict[str, str]:
        """Nothing here is a copy of one source file."""
        return {}

    def run(self) -> None:
        """Generate, compile, share out."""
        scratch = Path(self.build_temp).resolve()
        installed = scratch / "installed"
        run_cmake(scratch / "cmake", installed)

        modules = next(installed.glob("**/relpose_ros/msg/__init__.py")).parents[1]
        (installed / "bin" / "relpose_ros").unlink()  # pip writes its own, for the interpreter it runs in
        prefix_files = [
            path
            for path in sorted(installed.rglob("*"))
            if path.is_file() and modules.parent not in path.parents
        ]
        data_files = [(path.relative_to(installed).parent, path) for path in prefix_files]

        generated = [path for path in sorted(modules.rglob("*")) if is_generated(path.relative_to(modules))]
        if self.editable_mode:
            home = Path(SITE_PACKAGES, EDITABLE)
            hook = scratch / f"{EDITABLE}.pth"
            hook.write_text(f"import {EDITABLE}\n", encoding="utf-8")
            module = scratch / "__init__.py"
            shutil.copyfile(BUILD_SUPPORT / "editable_messages.py", module)
            data_files += [(Path(SITE_PACKAGES), hook), (home, module)]
            data_files += [(home / path.relative_to(modules.parent).parent, path) for path in generated]
        else:
            for path in generated:
                target = Path(self.build_lib, path.relative_to(modules.parent))
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(path, target)
        self.distribution.data_files = [(str(folder), [str(path)]) for folder, path in data_files]
        if self.editable_mode:
            self.run_command("install_data")  # setuptools leaves data files out of editable wheels


def is_generated(path: Path) -> bool:
    """Whether CMake generated this file of the package, and does not merely install it for colcon."""
    return path.suffix in {".py", ".so"} and (path.parts[0] == "msg" or path.suffix == ".so")


def run_cmake(build_folder: Path, installed: Path) -> None:
    """Configure, compile and install CMakeLists.txt into a folder of its own."""
    prefixes = generator_prefixes()
    search = {
        "AMENT_PREFIX_PATH": prefixes,
        "CMAKE_PREFIX_PATH": prefixes,
        "LD_LIBRARY_PATH": [prefix / "lib" for prefix in prefixes],
        "PATH": [prefix / "bin" for prefix in prefixes],
    }
    if sourced_prefixes():
        # pip's isolated builds hide the PYTHONPATH of a sourced ROS 2.
        python = f"lib/python{sys.version_info.major}.{sys.version_info.minor}/site-packages"
        search["PYTHONPATH"] = [prefix / python for prefix in prefixes]
    environment = dict(os.environ)
    for name, folders in search.items():
        known = [os.environ[name]] if os.environ.get(name) else []
        environment[name] = os.pathsep.join([str(folder) for folder in folders] + known)

    configure = [
        *("cmake", "-S", ROOT, "-B", build_folder, "-G", "Ninja"),
        f"-DCMAKE_INSTALL_PREFIX={installed}",
        f"-DCMAKE_INSTALL_RPATH={RUNTIME_PATHS}",
        f"-DPython3_EXECUTABLE={sys.executable}",
        f"-DPYTHON_EXECUTABLE={sys.executable}",
        "-DCMAKE_BUILD_TYPE=Release",
        "-DBUILD_TESTING=OFF",
    ]
    subprocess.run(configure, check=True, env=environment)
    subprocess.run(["cmake", "--build", build_folder, "--target", "install"], check=True, env=environment)


setup(
    distclass=PlatformDistribution,
    cmdclass={"build": Build, "build_messages": BuildMessages},
)
