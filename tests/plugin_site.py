"""The package of examples/plugin, installed for tests."""

from __future__ import annotations

import atexit
import importlib
import shutil
import subprocess
import sys
import tempfile
from functools import cache
from pathlib import Path

PLUGIN = Path(__file__).parents[1] / "examples" / "plugin"


def install_plugin(site: Path) -> None:
    """Install the plug-in into `site`, a folder on this process's path."""
    shutil.copytree(_installed(), site, dirs_exist_ok=True)
    importlib.invalidate_caches()


@cache
def _installed() -> Path:
    """The folder into which pip installs the plug-in, once for all tests of this process."""
    folder = Path(tempfile.mkdtemp())
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    source, site = shutil.copytree(PLUGIN, folder / "plugin"), folder / "site"
    options = ("--quiet", "--no-deps", "--no-build-isolation", "--no-index", "--target", str(site))
    subprocess.run([sys.executable, "-m", "pip", "install", *options, str(source)], check=True)
    return site
