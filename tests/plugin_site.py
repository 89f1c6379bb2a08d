"""The package of examples/plugin, installed for one test."""

from __future__ import annotations

import importlib
import shutil
import subprocess
import sys
from pathlib import Path

PLUGIN = Path(__file__).parents[1] / "examples" / "plugin"


def install_plugin(site: Path, folder: Path) -> None:
    """Install the plug-in into `site`, a folder on this process's path; `folder`: for its sources."""
    source = shutil.copytree(PLUGIN, folder / "plugin")
    options = ("--quiet", "--no-deps", "--no-build-isolation", "--no-index", "--target", str(site))
    subprocess.run([sys.executable, "-m", "pip", "install", *options, str(source)], check=True)
    importlib.invalidate_caches()
