"""A pretended GPU: tensors in the CPU's memory that say they are on cuda:0, and a `torch.cuda` for them.

It refuses what CUDA refuses: tensors of different devices and, while a graph is captured, whatever makes the host wait.
A captured graph repeats the recorded operations on the same memory, without calling the function: Python numbers keep
their recorded values. It cannot see kernels, dtypes that CUDA lacks, mixed precision, torch.compile, streams,
allocation, PhysX and rendering."""

import contextlib
from types import SimpleNamespace

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_map

aten = torch.ops.aten
CUDA = torch.device("cuda:0")
READS = {  # the host waits for what they return
    Tensor.item, Tensor.tolist, Tensor.cpu, Tensor.__bool__, Tensor.__int__, Tensor.__float__, Tensor.__index__,
    Tensor.__contains__, Tensor.__format__, Tensor.__repr__, Tensor.nonzero,
    Tensor.argwhere, Tensor.equal, Tensor.allclose, Tensor.unique, Tensor.masked_select, Tensor.bincount,
    torch.nonzero, torch.argwhere, torch.equal, torch.allclose, torch.unique, torch.masked_select, torch.bincount,
    torch.is_nonzero, torch.repeat_interleave,
}  # fmt: skip
READS_WITHIN = {  # the same, in what torch's functions call
    aten._local_scalar_dense.default, aten.nonzero.default, aten.masked_select.default, aten.equal.default,
}  # fmt: skip
COPIES = {Tensor.copy_, Tensor.to, Tensor.cpu, Tensor.cuda, Tensor.type}  # between devices
MAKES = {torch.tensor, torch.as_tensor, torch.from_numpy}  # from numbers that the host has


class GpuTensor(Tensor):
    device = property(lambda self: CUDA)
    is_cuda = property(lambda self: True)
    is_cpu = property(lambda self: False)

    def __deepcopy__(self, memo):
        if id(self) not in memo:
            memo[id(self)] = copied = self.detach().clone().requires_grad_(self.requires_grad)
            copied._is_param = isinstance(self, torch.nn.Parameter)
        return memo[id(self)]

    def __reduce_ex__(self, protocol):  # torch.save
        return to_cpu(self.detach()).__reduce_ex__(protocol)

    @classmethod
    def __torch_function__(cls, func, types, args=(), kwargs=None):
        return call(func, args, kwargs or {})


class PretendedGpu(TorchFunctionMode):
    """While it is entered, device="cuda" makes tensors of the pretended GPU. `waits` has the name of each operation
    for which the host waited; `refused` is why it must not wait now, if so."""

    waits: list[str] = []
    refused = None

    def __torch_function__(self, func, types, args=(), kwargs=None):
        return call(func, args, kwargs or {})


def is_on_gpu(x) -> bool:
    return isinstance(x, GpuTensor)


def to_gpu(x):
    """The same memory, said to be on the GPU."""
    return x.as_subclass(GpuTensor) if isinstance(x, Tensor) and not is_on_gpu(x) else x


def to_cpu(x):
    """The same memory, said to be on the CPU."""
    return x.as_subclass(Tensor) if is_on_gpu(x) else x


def find_tensors(tree) -> list:
    """The tensors in nested tuples, lists and dicts. Every call of torch comes here: tree_leaves would be slower."""
    if isinstance(tree, Tensor):
        return [tree]
    if isinstance(tree, dict):
        tree = tree.values()
    elif not isinstance(tree, (tuple, list)):
        return []
    return [x for branch in tree for x in find_tensors(branch)]


def wait(func) -> None:
    name = getattr(func, "__name__", str(func))
    PretendedGpu.waits.append(name)
    if PretendedGpu.refused:
        raise RuntimeError(f"{PretendedGpu.refused}: {name}")


def find_device(func, args: tuple, kwargs: dict):
    """The device that a call names, or None."""
    named = (*args[1:], *kwargs.values()) if func is Tensor.to else (kwargs.get("device"),)
    for x in named:
        if isinstance(x, (str, torch.device)):
            return torch.device(x)
        if isinstance(x, Tensor):
            return x.device
    return CUDA if func is Tensor.cuda else torch.device("cpu") if func is Tensor.cpu else None


def check_devices(func, args: tuple, on_gpu: list, on_cpu: list) -> None:
    """Raise CUDA's errors. Numbers on the CPU, which have no dimensions, may meet tensors on the GPU."""
    arrays = [x for x in on_cpu if x.ndim > 0]
    if not on_gpu or not arrays or func in COPIES:
        return
    if func in (Tensor.__getitem__, Tensor.__setitem__):
        indices = find_tensors(args[1])
        if is_on_gpu(args[0]):  # CUDA moves indices, and values unless there are indices
            if func is Tensor.__getitem__ or not indices or not any(x is args[2] for x in arrays):
                return
        elif not any(map(is_on_gpu, indices)):  # the value moves
            return
    raise RuntimeError(f"Expected all tensors to be on the same device, but found cuda:0 and cpu: {func.__name__}")


def convert(x: Tensor, args: tuple, kwargs: dict, device) -> Tensor:
    """What Tensor.to returns: the same memory if it has that device and dtype already, else a copy."""
    options = {k: v for k, v in kwargs.items() if k in ("dtype", "memory_format")}
    dtypes = [a.dtype if isinstance(a, Tensor) else a for a in args if isinstance(a, (Tensor, torch.dtype))]
    options |= dict(dtype=dtypes[0]) if dtypes else {}
    is_moved = device is not None and device.type != x.device.type
    return to_cpu(x).to(**options, copy=is_moved or kwargs.get("copy", False))


def call(func, args: tuple, kwargs: dict):
    """Check a call of torch, compute it on the CPU, and put the result where CUDA would."""
    with torch._C.DisableTorchFunctionSubclass():
        tensors = find_tensors((args, kwargs))
        on_gpu, on_cpu = [x for x in tensors if is_on_gpu(x)], [x for x in tensors if not is_on_gpu(x)]
        device = find_device(func, args, kwargs)
        result_on_gpu = bool(on_gpu) if device is None else device.type == "cuda"
        name = getattr(func, "__name__", "")
        if not on_gpu and not result_on_gpu or name in ("__set__", "__deepcopy__", "backward"):
            return func(*args, **kwargs)
        if func is torch._has_compatible_shallow_copy_type:  # nn.Module.to asks whether a parameter keeps its memory
            return not on_cpu
        if func in (Tensor.numpy, Tensor.__array__):
            raise TypeError("can't convert cuda:0 device type tensor to numpy")
        check_devices(func, args, on_gpu, on_cpu)
        has_mask = name == "__getitem__" and any(x.dtype == torch.bool and x.ndim > 0 for x in tensors[1:])
        leaves = bool(on_gpu) and not result_on_gpu and not kwargs.get("non_blocking")
        crosses = leaves or any(x.ndim > 0 or func in COPIES for x in on_cpu)
        if func in READS or crosses or has_mask or func in MAKES and not on_gpu:
            wait(func)
        if func in (Tensor.to, Tensor.cuda, Tensor.cpu):
            result = convert(args[0], args[1:], kwargs, device)
        else:
            result = func(*args, **(kwargs | dict(device="cpu") if device else kwargs))
        if isinstance(result, torch.Size):  # tree_map would return a tuple
            return result
        place = to_gpu if result_on_gpu else to_cpu
        return place(result) if isinstance(result, Tensor) else tree_map(place, result)


class Recording(TorchDispatchMode):
    """Stands for torch.cuda.CUDAGraph: records operations, to repeat them on the same memory."""

    def __init__(self):
        super().__init__()
        self.tape, self.num_replays = [], 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        if func in READS_WITHIN:
            wait(func)
        result = func(*args, **(kwargs or {}))
        self.tape.append((func, args, kwargs or {}, result))
        return result

    @torch.no_grad()
    def replay(self):
        self.num_replays += 1
        if self.num_replays == 1:  # other than CUDA's, this recording has computed already
            return
        with torch._C.DisableTorchFunction():
            for func, args, kwargs, before in self.tape:
                after = func(*args, **kwargs)
                for old, new in zip(find_tensors(before), find_tensors(after), strict=True):
                    if old.untyped_storage()._cdata != new.untyped_storage()._cdata:
                        old.detach().copy_(new)  # the operation was neither in place nor a view


class Stream:
    def wait_stream(self, other) -> None:
        pass

    def is_capturing(self) -> bool:
        return PretendedGpu.refused is not None


@contextlib.contextmanager
def capture(graph: Recording, **options):
    PretendedGpu.refused = "operation not permitted when stream is capturing"
    try:
        with graph:
            yield
    finally:
        PretendedGpu.refused = None


def synchronize(*device) -> None:
    wait(synchronize)


def set_sync_debug_mode(mode: str) -> None:
    PretendedGpu.refused = "the host must not wait" if mode == "error" else None


def group_by_device(lists, with_indices=False):
    """The optimizer computes the tensors of a device together."""
    groups = {}
    for (device, dtype), group in GROUP(lists, with_indices).items():
        groups[CUDA if is_on_gpu(group[0][0][0]) else device, dtype] = group
    return groups


GROUP = torch._C._group_tensors_by_device_and_dtype
TORCH_CUDA = SimpleNamespace(
    is_available=lambda: True, is_bf16_supported=lambda: True, device_count=lambda: 1, current_device=lambda: 0,
    set_device=lambda device: None, synchronize=synchronize, get_device_name=lambda *device: "a pretended GPU",
    mem_get_info=lambda *device: (2**34, 2**34), manual_seed=lambda seed: None, manual_seed_all=lambda seed: None,
    get_rng_state=lambda *device: None, set_rng_state=lambda *state: None,  # it draws from the CPU's generator
    is_current_stream_capturing=lambda: Stream().is_capturing(), set_sync_debug_mode=set_sync_debug_mode,
    Stream=Stream, current_stream=Stream,
    stream=lambda stream: contextlib.nullcontext(), CUDAGraph=Recording, graph=capture,
)  # fmt: skip
TORCH_ACCELERATOR = SimpleNamespace(current_accelerator=lambda check_available=False: CUDA, current_stream=Stream)


@contextlib.contextmanager
def pretended_gpu(monkeypatch):
    with monkeypatch.context() as patch, PretendedGpu():
        for module, pretended in ((torch.cuda, TORCH_CUDA), (torch.accelerator, TORCH_ACCELERATOR)):
            for name, value in vars(pretended).items():
                patch.setattr(module, name, value)
        patch.setattr(torch._C, "_group_tensors_by_device_and_dtype", group_by_device)
        PretendedGpu.waits, PretendedGpu.refused = [], None
        yield


def simulate_on_gpu(monkeypatch, *scripts) -> None:
    """Let batches of ManiSkill's tasks, which the CPU simulates, have tensors of the pretended GPU. In one process, the
    script that was imported last simulates for all of them."""
    sapien_env, physx = scripts[0].sapien_env, scripts[0].physx
    parse = sapien_env.parse_sim_and_render_backend

    def parse_as_gpu(*backends):
        backend = parse(*backends)
        backend.device = CUDA
        return backend

    monkeypatch.setattr(sapien_env, "parse_sim_and_render_backend", parse_as_gpu)
    monkeypatch.setattr(physx, "enable_gpu", lambda: None)
    monkeypatch.setattr(physx, "is_gpu_enabled", lambda: True)
    for script in scripts:
        get_picture = script.BatchedRenderer.get_picture_cuda

        def get_picture_on_gpu(renderer, name, get_picture=get_picture):
            picture = to_gpu(get_picture(renderer, name).torch())
            return SimpleNamespace(torch=lambda: picture)

        monkeypatch.setattr(script, "is_batch", lambda scene: type(scene.px).__name__ == "BatchedPhysx")
        monkeypatch.setattr(script.Array, "torch", lambda array: to_gpu(array.data))
        monkeypatch.setattr(script.BatchedRenderer, "get_picture_cuda", get_picture_on_gpu)
