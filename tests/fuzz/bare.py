"""An environment without any extra: the packages of all are hidden from imports, as if absent."""

import re
import sys
import tomllib
from pathlib import Path
from typing import Any

TOP = Path(__file__).resolve().parents[2]
#: Extra -> its packages, of those that users install; and what no extra has.
EXTRAS = {
    extra: [re.split(r"[^\w-]", line)[0].replace("-", "_") for line in lines]
    for extra, lines in tomllib.loads((TOP / "pyproject.toml").read_text())["project"][
        "optional-dependencies"
    ].items()
    if extra not in ("docs", "dev")
}
HIDDEN = {package for packages in EXTRAS.values() for package in packages} - {"palpate"}
HIDDEN |= {"tensorboard", "tensorboardX", "torchmetrics", "wandb"}


class _Finder:
    """A finder of modules that does not find some.

    Args:
        finder: the finder behind it.
    """

    def __init__(self, finder: Any) -> None:
        self.finder = finder

    def find_spec(self, name: str, *where: Any) -> Any:
        hidden = name.partition(".")[0] in HIDDEN
        return None if hidden else self.finder.find_spec(name, *where)

    def find_distributions(self, *context: Any) -> Any:
        found = getattr(self.finder, "find_distributions", lambda *_: ())(*context)
        return (d for d in found if d.metadata["Name"].replace("-", "_") not in HIDDEN)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.finder, name)


def hide() -> None:
    """Hide the packages from here on."""
    sys.meta_path[:] = [_Finder(finder) for finder in sys.meta_path]
    for name in [name for name in sys.modules if name.partition(".")[0] in HIDDEN]:
        del sys.modules[name]
