"""What can this machine do? A table of what ManiSkill and the training scripts find, and how to mend what is missing.

    python examples/check_machine.py

It needs nothing but Python: what is not installed, broken, or crashes is a row of the table. Whatever might crash is
tried in a process of its own."""

import importlib.metadata
import math
import os
import platform
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Optional

ROOT = Path(__file__).resolve().parent.parent  # ppo.py lies here, and says what it needs
PACKAGES = re.findall(r'^#     "([\w-]+).*>=([\d.]+)', (ROOT / "ppo.py").read_text(), flags=re.MULTILINE)

VULKAN = """
import sapien
for name in ("cuda", "pci:0", "cpu"):
    try:
        device = sapien.Device(name)
    except RuntimeError:
        continue
    if device.can_render():
        kind = "hardware" if device.is_cuda() else "without CUDA: software, or a GPU of another make"
        print(f"{device.name} ({kind})")
        break
else:
    raise SystemExit("no Vulkan device that SAPIEN can render with")
"""

TORCH = """
import torch
torch.zeros(1, device="cuda")
names = [torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count())]
print(f"{', '.join(names)}; torch {torch.__version__}")
"""

PHYSX_FILE = """
import platform, sapien.physx
from pathlib import Path
folder = Path.home() / ".sapien" / "physx" / sapien.physx.version()
file = folder / ("PhysXGpu_64.dll" if platform.system() == "Windows" else "libPhysXGpu_64.so")
if file.exists():
    print(file)
else:
    import requests
    linux = "linux-so" if platform.machine() in ("x86_64", "AMD64") else "linux-aarch64-so"
    kind = "windows-dll" if platform.system() == "Windows" else linux
    url = f"https://github.com/sapien-sim/physx-precompiled/releases/download/{sapien.physx.version()}/{kind}.zip"
    try:
        reachable = requests.head(url, timeout=10, allow_redirects=True).ok
    except requests.RequestException:
        reachable = False
    if not reachable:
        raise SystemExit(f"not in {folder}, and cannot be downloaded: unzip {url} there")
    print("will be downloaded at the first use (80 MB)")
"""

SIMULATE = """
import sys, warnings
sys.path.insert(0, {root!r})
warnings.simplefilter("ignore")
import ppo, torch
env = ppo.gym.make("PushCube-v1", num_envs={num_envs}, obs_mode={obs_mode!r}, sim_backend={sim_backend!r},
                   render_backend={render_backend!r}, sensor_configs=dict(width=64, height=64))
obs, _ = env.reset(seed=0)
for _ in range(3):
    obs, *_ = env.step(torch.zeros(env.action_space.shape))
print("PushCube-v1 was built and stepped")
"""


def attempt(code: str) -> tuple[bool, str]:
    """Run code in a fresh interpreter: whether it succeeded, and the last line that it printed."""
    try:
        process = subprocess.run(
            [sys.executable, "-W", "ignore", "-c", code], capture_output=True, text=True, timeout=300,
            stdin=subprocess.DEVNULL,
        )  # fmt: skip
    except Exception as error:
        return False, f"{type(error).__name__}: {error}"
    succeeded = process.returncode == 0
    lines = [line.strip() for line in (process.stdout if succeeded else process.stderr).splitlines() if line.strip()]
    return succeeded, lines[-1] if lines else f"ended with exit code {process.returncode}"


def version(package: str) -> Optional[str]:
    try:
        return importlib.metadata.version(package)
    except Exception:
        return None


def as_numbers(version: str) -> list[int]:
    """To compare versions."""
    return [int(x) for x in re.findall(r"\d+", version)[:3]]


def read(path: str) -> str:
    try:
        return Path(path).read_text().strip()
    except OSError:
        return ""


def row(good: Optional[bool], name: str, found: str, remedy: str = "") -> None:
    """Print one line of the table: ok, missing, or (None) neither good nor bad."""
    print(f"{ {True: 'ok     ', False: 'missing', None: '       '}[good] }  {name:<26}{found}")
    if good is False and remedy:
        print(f"{'':<35}-> {remedy}")


def show_shared_memory(cores: int) -> None:
    """With CPU simulation, each process writes its observations to shared memory. Images may be too much."""
    free = shutil.disk_usage("/dev/shm").free
    steps = 1600
    side = math.isqrt(max(0, int(0.9 * free) - 16 * 2**20) // (3 * steps))  # the rest is for all that is no image
    found = f"{free / 2**20:,.0f} MiB free: "
    if cores == 1:
        found += "one core needs none"
    elif free < 16 * 2**20:
        found += "hardly enough for states, too little for images"
    else:
        found += f"enough for states, and for colour images of up to {side}x{side} ({steps:,} steps an iteration)"
    remedy = "--shm-size=1g for the container; without it, fewer steps or --num_actors 1, for ppo_rgb.py on a CPU"
    row(cores == 1 or side >= 128, "shared memory", found, remedy)


def main() -> None:
    remedy = "use Python 3.10, 3.11 or 3.12: mani-skill's dependencies have no other"
    row((3, 10) <= sys.version_info[:2] <= (3, 12), "Python", platform.python_version(), remedy)
    for package, lowest in PACKAGES:
        found = version(package)
        is_new = found is not None and as_numbers(found) >= as_numbers(lowest)
        row(is_new, package, found or "not installed", f'pip install "{package}>={lowest}"')
    row(None, "wandb (for --track)", version("wandb") or "not installed")

    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    quota = read("/sys/fs/cgroup/cpu.max").split()
    limited = len(quota) == 2 and quota[0] != "max" and int(quota[0]) / int(quota[1])
    row(None, "cores", f"{cores}" + (f", and a quota allows {limited:.1f} of them" if limited else ""))
    if limited:
        cores = min(cores, math.ceil(limited))
    try:
        memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):
        memory = 0
    limit = read("/sys/fs/cgroup/memory.max")
    memory = min(memory, int(limit)) if limit.isdigit() else memory
    row(None, "memory", f"{memory / 2**30:.0f} GiB")
    if Path("/dev/shm").exists():
        show_shared_memory(cores)
    row(None, "free disk here", f"{shutil.disk_usage('.').free / 2**30:.0f} GiB")

    driver = read("/proc/driver/nvidia/version").splitlines()
    driver = next((word for line in driver for word in line.split() if word[:1].isdigit() and "." in word), "")
    row(bool(driver) or None, "NVIDIA driver", driver or "none")
    cuda, found = attempt(TORCH)
    libcuda = physx = False
    if driver or cuda:
        remedy = "a newer driver, or a torch built for this one (pytorch.org); in a container, its GPU options"
        row(cuda, "CUDA for torch", found, remedy)
        libcuda, found = attempt("import ctypes; ctypes.CDLL('libcuda.so'); print('found')")
        remedy = "ln -s libcuda.so.1 libcuda.so, in the folder that `ldconfig -p | grep libcuda` names"
        row(libcuda, "libcuda.so", found, remedy)
        physx, found = attempt(PHYSX_FILE)
        row(physx, "PhysX's GPU library", found)
    else:
        row(None, "CUDA for torch", found)
    vulkan, found = attempt(VULKAN)
    remedy = "apt install mesa-vulkan-drivers (23.1 or newer: on Debian 12 from its backports suite)"
    if driver:
        remedy = "NVIDIA's Vulkan driver; in a container NVIDIA_DRIVER_CAPABILITIES=all"
    row(vulkan, "Vulkan", found, remedy)

    print("\nwhat therefore works (tried):")
    gpu = cuda and libcuda and physx
    for name, possible, num_envs, sim_backend, obs_mode, render_backend in (
        ("state, CPU simulation", True, 2, "physx_cpu", "state", "none"),
        ("images, CPU simulation", vulkan, 2, "physx_cpu", "rgb", "gpu"),
        ("state, GPU simulation", gpu, 2, "physx_cuda", "state", "none"),
        ("images, GPU simulation", gpu and vulkan, 2, "physx_cuda", "rgb", "gpu"),
    ):
        if not possible:
            row(None, name, "no: see above")
            continue
        code = SIMULATE.format(root=str(ROOT), num_envs=num_envs, obs_mode=obs_mode, sim_backend=sim_backend,
                               render_backend=render_backend)  # fmt: skip
        works, found = attempt(code)
        row(works, name, found)


if __name__ == "__main__":
    main()
