"""In an editable installation relpose_ros is the checkout, and its generated messages stand here.

Compiled messages belong to one environment and its Python, and a checkout may serve several environments.
"""

from __future__ import annotations

import sys
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path

GENERATED = str(Path(__file__).parent / "relpose_ros")


class MessagesFinder:
    """Finds relpose_ros.msg and its type support beside this file, wherever relpose_ros itself was found."""

    @staticmethod
    def find_spec(name: str, *_: object) -> ModuleSpec | None:
        """Tell where a module is; None leaves it to the usual finders."""
        package, _, module = name.partition(".")
        if package == "relpose_ros" and (module == "msg" or module.startswith("relpose_ros_s__")):
            return PathFinder.find_spec(name, [GENERATED])
        return None


sys.meta_path.insert(0, MessagesFinder)
