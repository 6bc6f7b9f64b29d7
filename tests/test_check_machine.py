"""examples/check_machine.py: true where all is well, and no crash where nothing is."""

import os
import subprocess
import sys

import pytest
from conftest import NO_VULKAN, ROOT


def check_machine(**environment):
    process = subprocess.run(
        [sys.executable, str(ROOT / "examples/check_machine.py")], env={**os.environ, **environment},
        capture_output=True, text=True, timeout=300,
    )  # fmt: skip
    assert process.returncode == 0 and process.stderr == "" and "Traceback" not in process.stdout
    return process.stdout


def test_without_vulkan():
    table = check_machine(**NO_VULKAN)
    assert "ok       state, CPU simulation     PushCube-v1 was built and stepped" in table
    assert "missing  Vulkan" in table and "-> apt install mesa-vulkan-drivers" in table
    assert "images, CPU simulation    no: see above" in table
    assert all(f"ok       {package} " in table for package in ("mani-skill", "sapien", "torch", "psutil"))


@pytest.mark.slow
@pytest.mark.render
def test_with_vulkan():
    table = check_machine()
    assert "ok       Vulkan" in table
    assert "ok       images, CPU simulation    PushCube-v1 was built and stepped" in table


def test_where_all_is_broken(tmp_path):
    """Modules that cannot be imported, or take the process with them."""
    (tmp_path / "torch.py").write_text("raise OSError('libtorch.so: cannot open shared object file')")
    (tmp_path / "sapien.py").write_text("import os, signal; os.kill(os.getpid(), signal.SIGSEGV)")
    table = check_machine(PYTHONPATH=str(tmp_path))
    assert "libtorch.so: cannot open shared object file" in table
    assert "missing  Vulkan                    ended with exit code -11" in table
    assert "missing  state, CPU simulation     ended with exit code -11" in table
