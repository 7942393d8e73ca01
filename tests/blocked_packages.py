"""Blocks the import of packages; as a program it is `touchgoal` without MuJoCo and Gymnasium."""

import sys
from importlib.abc import MetaPathFinder

SIMULATOR = ("mujoco", "gymnasium")


class Blocker(MetaPathFinder):
    def __init__(self, *packages: str) -> None:
        self.packages = packages
        sys.meta_path.insert(0, self)

    def find_spec(self, fullname: str, path: object = None, target: object = None) -> None:
        if fullname.split(".")[0] in self.packages:
            raise ImportError(f"{fullname} is blocked")


if __name__ in ("__main__", "__mp_main__"):  # in an arm's driver process, too
    Blocker(*SIMULATOR)
if __name__ == "__main__":
    from touchgoal.launch.__main__ import main

    main()
