"""Compiled CUDA C++, and machine code on disk."""

import pytest

from mvrecon.kernels.cuda import nvrtc


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "mvrecon" / "kernels"


def never() -> bytes:
    pytest.fail("it is on disk")


def test_code_is_compiled_once(folder):
    assert nvrtc.cached("a", lambda: b"code") == b"code"
    assert nvrtc.cached("a", never) == b"code"
    assert [file.name for file in folder.iterdir()] == ["a.bin"]
    assert folder.stat().st_mode & 0o077 == 0


@pytest.mark.parametrize("damage", ["cut", "changed", "empty"])
def test_damaged_code_is_recompiled(damage, folder):
    """A damaged file of compiled GPU kernels is recompiled and never run."""
    nvrtc.cached("a", lambda: b"code")
    whole = (folder / "a.bin").read_bytes()
    damaged = {"cut": whole[:-1], "changed": whole[:-1] + b"E", "empty": b""}[damage]
    (folder / "a.bin").write_bytes(damaged)
    assert nvrtc.cached("a", lambda: b"again") == b"again"
    assert nvrtc.cached("a", never) == b"again"


@pytest.mark.parametrize("writable", ["file", "folder"])
def test_code_writable_by_others_is_not_run(writable, folder, caplog):
    """Compiled GPU kernels that another user could have written are not run."""
    nvrtc.cached("a", lambda: b"code")
    (folder / "a.bin" if writable == "file" else folder).chmod(0o777)
    assert nvrtc.cached("a", lambda: b"own") == b"own"
    assert "others may write it" in caplog.text


def test_a_read_only_folder_only_costs_time(folder, caplog):
    folder.parent.mkdir()
    folder.write_text("a file")
    assert nvrtc.cached("a", lambda: b"code") == b"code"
    assert "cannot be kept" in caplog.text or "cannot be read" in caplog.text


def test_a_device_newer_than_the_compiler_uses_code_translated_by_its_driver():
    assert nvrtc.target(90, [80, 90]) == "sm_90"
    assert nvrtc.target(120, [80, 90]) == "compute_90"
    assert nvrtc.target(86, [75, 80, 90]) == "compute_80"


def test_the_same_kernels_are_compiled_once_and_read_afterwards(host, monkeypatch):
    """By a process, and by the next one."""
    import torch

    from mvrecon.kernels.cuda.launch import RAYS, Variant, kernels_of

    variant, device = Variant(RAYS, torch.float32), torch.device("cpu")
    first = kernels_of(variant, device)
    assert kernels_of(variant, device) is first and host.modules == 1
    kernels_of.cache_clear()
    monkeypatch.setattr(nvrtc, "build", lambda *_: pytest.fail("it is on disk"))
    assert kernels_of(variant, device).keys() == first.keys() and host.modules == 2


def test_nvrtc_s_own_headers_are_loaded_before_it(tmp_path, monkeypatch):
    """NVRTC loads them by their bare name, and a wheel's folder is not searched."""
    folder, opened = tmp_path / "nvidia" / "cu13" / "lib", []
    folder.mkdir(parents=True)
    for name in ("libnvrtc.so.13", "libnvrtc-builtins.so.13.0"):
        (folder / name).touch()
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(nvrtc.ctypes, "CDLL", lambda path: opened.append(path) or path)
    assert nvrtc.library.__wrapped__() == str(folder / "libnvrtc.so.13")
    assert opened == [str(folder / "libnvrtc-builtins.so.13.0"), str(folder / "libnvrtc.so.13")]
