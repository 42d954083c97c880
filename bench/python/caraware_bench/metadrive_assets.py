"""`python -m caraware_bench.metadrive_assets`: gives the MetaDrive of this environment its models and textures.

MetaDrive downloads them from its project's releases when it first runs. The wheel of an older version has them as well,
and a package index is all that the rest needs. Without a window they are hardly used: nothing is drawn.
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
"""What the newer version takes as a sign of its own assets."""


def main() -> None:
    """Unpacks the older assets where the newer version looks for its own."""
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
