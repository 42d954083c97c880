"""`python -m caraware_bench.metadrive_assets`: installs the models and textures of MetaDrive in this environment.

MetaDrive downloads them from its project's releases when it first runs. This program takes them from the wheel of an
older version instead, so that only a package index is needed. Without a window MetaDrive draws nothing and hardly uses
them.
"""

import subprocess
import sys
import tempfile
from pathlib import Path
from zipfile import ZipFile

import metadrive
from metadrive.constants import VERSION

WITH_ASSETS = "metadrive-simulator==0.3.0.1"
"""The newest wheel that has the assets."""
ASKED_FOR = "textures/grass1/GroundGrassGreen002_COL_1K.jpg"
"""The file from which the newer version concludes that its own assets are installed."""


def main() -> None:
    """Unpack the older assets into the directory of the newer version."""
    assets = Path(metadrive.__file__).parent / "assets"
    with tempfile.TemporaryDirectory() as directory:
        pip = [sys.executable, "-m", "pip", "download", "--disable-pip-version-check", "--quiet", "--no-deps"]
        subprocess.run([*pip, "--dest", directory, WITH_ASSETS], check=True)
        (wheel,) = Path(directory).glob("*.whl")
        with ZipFile(wheel) as archive:
            names = [name for name in archive.namelist() if name.startswith("metadrive/assets/")]
            archive.extractall(assets.parents[1], names)
    (assets / "version.txt").write_text(VERSION)
    texture = assets / ASKED_FOR
    texture.parent.mkdir(parents=True, exist_ok=True)
    texture.touch()


if __name__ == "__main__":
    main()
