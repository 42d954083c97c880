"""`_native.pyi` has the names, signatures and kinds of the built extension, by mypy's stubtest."""

import subprocess
import sys
from pathlib import Path

TRAINER = Path(__file__).parents[1]


def test_the_stub_is_the_built_module(tmp_path: Path) -> None:
    allowed = tmp_path / "allowed"
    # Python 3.12 shows the buffer protocol as a method; before, it is there without a name.
    allowed.write_text("" if sys.version_info >= (3, 12) else "caraware._native.SectionView.__buffer__\n")
    # The stub names torch's tensor alone: to read all of torch takes 20 s of a core, and no signature differs by it.
    config = tmp_path / "mypy.ini"
    config.write_text("[mypy]\n[mypy-torch.*]\nfollow_imports = skip\n")
    command = [sys.executable, "-m", "mypy.stubtest", "caraware._native", "--allowlist", str(allowed)]
    command += ["--mypy-config-file", str(config)]
    ran = subprocess.run(command, cwd=TRAINER, capture_output=True, text=True, timeout=300)
    assert ran.returncode == 0, ran.stdout + ran.stderr
