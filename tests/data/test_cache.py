"""The cache returns the requested result or computes it, never anything else."""

import logging
import multiprocessing
import os
import runpy
import shutil
import time
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import save

from meshspiral import geometry
from meshspiral.data.cache import Cache, CacheError, code_version, digest
from meshspiral.data.descriptors.shot import Shot
from meshspiral.data.preprocessing import Task, descriptor_task, neighbourhood_task, run_tasks
from meshspiral.data.settings import ShotSettings
from tests.meshes import bumpy_sphere
from tests.neighbourhoods.made import patch


@pytest.fixture
def cache(tmp_path):
    return Cache(tmp_path / "cache")


ARRAYS = {"a": np.arange(12.0).reshape(3, 4), "b": np.array(7)}


def same(arrays):
    return arrays.keys() == ARRAYS.keys() and all((arrays[k] == ARRAYS[k]).all() for k in ARRAYS)


def test_saved_arrays_are_loaded_and_no_other_file_is_left(cache):
    assert cache.load("kind", "key") is None
    cache.save("kind", "key", ARRAYS)
    assert same(cache.load("kind", "key"))
    assert [p.name for p in cache.root.rglob("*") if p.is_file()] == ["key.safetensors"]
    [entry] = cache.entries()
    assert entry[:2] == (cache.path("kind", "key"), cache.path("kind", "key").stat().st_size)


@pytest.mark.skipif(os.name == "nt", reason="Windows has no file modes")
def test_the_umask_decides_who_may_read_a_file(cache):
    cache.save("shot", "a", {"x": np.zeros(2)})
    umask = os.umask(0)
    os.umask(umask)
    assert cache.path("shot", "a").stat().st_mode & 0o777 == 0o666 & ~umask


def test_a_result_is_computed_once(cache):
    calls = []
    for _ in range(3):
        assert same(cache.get("kind", "key", lambda: calls.append(1) or ARRAYS))
    assert len(calls) == 1


def damage_truncate(path):
    path.write_bytes(path.read_bytes()[:-40])


def damage_empty(path):
    path.write_bytes(b"")


def damage_text(path):
    path.write_text("not a tensor file")


def damage_bit(path):
    data = bytearray(path.read_bytes())
    at = data.index(ARRAYS["a"].tobytes()) + 17
    data[at] ^= 4
    path.write_bytes(data)


def damage_foreign(path):
    path.write_bytes(save({"a": np.zeros(3)}, {"key": "another"}))


def damage_another_array(path):
    path.write_bytes(save({"a": np.zeros(3), "c": np.zeros(3)}, {"key": "key"}))


def damage_keyless(path):
    path.write_bytes(save({"a": np.zeros(3)}))


def damage_npy(path):
    with open(path, "wb") as file:
        np.save(file, np.zeros(3))


@pytest.mark.parametrize(
    "damage",
    [
        damage_truncate,
        damage_empty,
        damage_text,
        damage_bit,
        damage_foreign,
        damage_keyless,
        damage_another_array,
        damage_npy,
    ],
)
def test_a_damaged_or_foreign_file_is_computed_again_with_a_warning(cache, damage, caplog):
    cache.save("kind", "key", ARRAYS)
    damage(cache.path("kind", "key"))
    with caplog.at_level(logging.WARNING):
        assert same(cache.get("kind", "key", lambda: ARRAYS))
    assert "computing it again" in caplog.text and "key.safetensors" in caplog.text
    assert same(cache.load("kind", "key"))


def test_a_crash_while_writing_leaves_no_file(cache, monkeypatch):
    def interrupted(source, target):
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "replace", interrupted)
    with pytest.raises(KeyboardInterrupt):
        cache.save("kind", "key", ARRAYS)
    assert not [p for p in cache.root.rglob("*") if p.is_file()]


def test_a_full_disk_gives_one_message_and_loses_no_result(cache, monkeypatch):
    cache.save("kind", "old", ARRAYS)

    def full(source, target):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(CacheError, match=r"cannot write the cache .*No space left.*cache_dir="):
        cache.save("kind", "new", ARRAYS)
    assert [p.name for p in cache.root.rglob("*") if p.is_file()] == ["old.safetensors"]


def test_an_unwritable_folder_gives_one_message(tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(CacheError, match="cannot write the cache"):
        Cache(tmp_path / "file").save("kind", "key", ARRAYS)


def write_often(root, value):
    cache = Cache(root)
    for _ in range(20):
        cache.save("kind", "key", {"a": np.full(5000, value)})


def test_two_processes_can_write_the_same_key(cache, caplog):
    context = multiprocessing.get_context("fork")  # spawn would import torch twice
    writers = [context.Process(target=write_often, args=(cache.root, v)) for v in (1, 2)]
    for writer in writers:
        writer.start()
    seen = []
    caplog.set_level(logging.WARNING)
    while any(writer.is_alive() for writer in writers):
        if (arrays := cache.load("kind", "key")) is not None:
            seen.append(set(arrays["a"].tolist()))
    assert all(writer.exitcode == 0 for writer in writers)
    assert cache.load("kind", "key") is not None and all(len(values) == 1 for values in seen)
    assert seen and "damaged" not in caplog.text
    assert [p.name for p in cache.root.rglob("*") if p.is_file()] == ["key.safetensors"]


def tasks():
    shot = Shot(ShotSettings(radius=0.3, bins=4, by_area=False))
    spheres = [bumpy_sphere(seed, subdivisions=3) for seed in range(4)]
    return [
        task
        for mesh in spheres
        for task in (descriptor_task(mesh, shot), neighbourhood_task(mesh, patch(0.1, 3, 8)))
    ]


def prepare(root, started):
    started.release()
    run_tasks(tasks(), Cache(root), 1, "Preparing")


def test_four_processes_share_a_cold_cache_and_one_is_killed(tmp_path, caplog):
    context = multiprocessing.get_context("spawn")
    started = context.Semaphore(0)
    processes = [
        context.Process(target=prepare, args=(tmp_path / "all", started)) for _ in range(4)
    ]
    for process in processes:
        process.start()
    assert started.acquire(timeout=300)
    end = time.monotonic() + 300
    while not any((tmp_path / "all").rglob("*.safetensors")):  # until the first result is written
        assert time.monotonic() < end
    processes[0].kill()  # at a random point of its work
    for process in processes:
        process.join(300)
    assert [process.exitcode for process in processes] == [-9] + 3 * [0]
    prepare(tmp_path / "one", context.Semaphore(0))
    caplog.set_level(logging.WARNING)
    for task in tasks():
        shared, alone = (
            Cache(tmp_path / name).load(task.kind, task.key) for name in ("all", "one")
        )
        assert shared.keys() == alone.keys()
        for name in shared:
            np.testing.assert_array_equal(shared[name], alone[name])
    assert "damaged" not in caplog.text


def test_a_digest_depends_on_type_shape_value_and_order():
    a = np.arange(6, dtype=np.int32)
    digests = [
        digest(a),
        digest(a.astype(np.int64)),
        digest(a.reshape(2, 3)),
        digest(a[::-1]),
        digest(a, 1),
        digest(a, 2),
        digest(a, 1.0),
        digest(a, None),
        digest(a, "1"),
        digest(1, a),
        digest("ab", "c"),
        digest("a", "bc"),
    ]
    assert len(set(digests)) == len(digests)
    assert digest(a.copy()) == digest(a)


def test_the_code_version_depends_on_the_source(tmp_path, monkeypatch):
    import importlib

    monkeypatch.syspath_prepend(tmp_path)
    versions = []
    for i in range(2):
        (tmp_path / f"module_{i}.py").write_text(f"x = {i}\n")
        versions.append(code_version(importlib.import_module(f"module_{i}")))
    assert versions[0] != versions[1]


def test_compiled_code_is_kept_apart_for_other_sources(tmp_path, monkeypatch):
    """Numba itself does not notice a change in a function that another file calls."""
    package, folders = Path(geometry.__file__).parent, []
    for change in ("", "# changed\n"):
        copy = shutil.copytree(package, tmp_path / f"geometry{len(change)}")
        with open(copy / "angles.py", "a") as file:
            file.write(change)
        runpy.run_path(str(copy / "__init__.py"))
        folders.append(os.environ["NUMBA_CACHE_DIR"])
    assert folders[0] != folders[1]
    monkeypatch.setenv("NUMBA_CACHE_DIR", "/mine")
    runpy.run_path(str(package / "__init__.py"))
    assert os.environ["NUMBA_CACHE_DIR"] == "/mine"
    monkeypatch.undo()
    runpy.run_path(str(package / "__init__.py"))


def test_the_code_version_depends_on_the_geometry_that_a_module_imports(monkeypatch):
    import inspect

    from meshspiral.geometry import connectivity, laplacian, shot
    from meshspiral.neighbourhoods import sampled

    version, source = code_version.__wrapped__, inspect.getsource
    before = version(sampled)
    for changed, differs in ((shot, False), (connectivity, True), (laplacian, False)):

        def edited(module, changed=changed):
            return source(module) + "# edited" * (module is changed)

        monkeypatch.setattr(inspect, "getsource", edited)
        assert (version(sampled) != before) == differs, changed


def test_results_that_another_process_saved_meanwhile_are_not_computed_again(tmp_path):
    cache, done = Cache(tmp_path), []

    def compute(key):
        for each in "abc":  # as if other processes had saved all results
            cache.save("toys", each, {"x": np.zeros(1)})
        done.append(key)
        return {"x": np.zeros(1)}

    run_tasks([Task("toys", key, compute, (key,)) for key in "abc"], cache, 1, "Preparing")
    assert len(done) == 1


def test_looking_for_damage_is_not_reading(cache):
    cache.save("kind", "a", {"x": np.zeros(100)})
    os.utime(cache.path("kind", "a"), (1e9, 1e9))
    assert list(cache.damaged()) == []
    assert [entry.read for entry in cache.entries()] == [1e9]


def test_what_a_killed_process_left_goes_after_a_day(cache):
    cache.save("kind", "a", {"x": np.zeros(100)})
    size = cache.size()
    left = [cache.path("kind", "a").with_name(f"a.safetensors.{i}.tmp") for i in range(2)]
    for path in left:
        path.write_bytes(bytes(10))
    os.utime(left[0], (1e9, 1e9))
    assert cache.size() == size + 20
    assert [entry.path for entry in cache.prune(None, None)] == [left[0]]
    assert cache.size() == size + 10


def test_what_was_read_last_stays(cache):
    now = time.time()
    for days, name in enumerate("abcd"):
        cache.save("kind", name, {"x": np.zeros(100)})
        os.utime(cache.path("kind", name), (now, now - days * 86400 - 60))
    one = cache.entries()[0].size
    assert cache.prune(None, None) == []
    cache.load("kind", "d", check=False)  # now it is the newest
    assert [e.path.stem for e in cache.prune(None, now - 2 * 86400)] == ["c"]
    assert [e.path.stem for e in cache.prune(2.5 * one, None)] == ["b"]
    assert {e.path.stem for e in cache.entries()} == {"a", "d"}
    assert [e.path.stem for e in cache.prune(0, None)] == ["d", "a"]
