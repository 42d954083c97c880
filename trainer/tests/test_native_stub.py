"""`_native.pyi` has the names, signatures and kinds of the built extension, by mypy's stubtest."""

import subprocess
import sys
from pathlib import Path

TRAINER = Path(__file__).parents[1]


def test_the_stub_is_the_built_module(tmp_path: Path) -> None:
    allowed = tmp_path / "allowed"
    # Python 3.12 shows the buffer protocol as a method; before, it is there without a name.
    allowed.write_text("" if sys.version_info >= (3, 12) else "caraware._native.SectionView.__buffer__\n")
    command = [sys.executable, "-m", "mypy.stubtest", "caraware._native", "--allowlist", str(allowed)]
    ran = subprocess.run(command, cwd=TRAINER, capture_output=True, text=True, timeout=300)
    assert ran.returncode == 0, ran.stdout + ran.stderr
