"""Show and bound the cache: `python -m src.cache max_gb=20`."""

from __future__ import annotations

import logging
import time
from collections import defaultdict
from collections.abc import Sequence

from meshspiral.experiment.entry import entry_point
from meshspiral.experiment.schema import CacheConfig, ConfigError

log = logging.getLogger(__name__)
DAY = 24 * 60 * 60.0
ROW = "{:<14} {:>8} {:>10} {:>12}"


@entry_point("cache", CacheConfig)
def main(config: CacheConfig) -> None:
    from meshspiral.data.cache import Cache

    cache = Cache(config.cache_dir)
    if not cache.root.is_dir():
        raise ConfigError(f"cache_dir must be a folder, got {cache.root}")
    now = time.time()
    for line in _table(cache.entries(), now):
        log.info(line)
    if config.verify:
        damaged = [entry.path for entry in cache.damaged()]  # a warning names each
        for path in damaged:
            path.unlink(missing_ok=True)
        log.info("%d damaged files removed", len(damaged))
    if config.unused_days is None and config.max_gb is None:
        return
    most = None if config.max_gb is None else config.max_gb * 1e9
    since = None if config.unused_days is None else now - config.unused_days * DAY
    removed = cache.prune(most, since)
    size = sum(entry.size for entry in removed)
    log.info(
        "removed %d files, %.1f MB; %.1f MB are left", len(removed), size / 1e6, cache.size() / 1e6
    )


def _table(entries: Sequence, now: float) -> list[str]:
    kinds = defaultdict(list)
    for entry in entries:
        kinds[entry.path.parent.name].append(entry)
    lines = [ROW.format("kind", "files", "MB", "last read")]
    for kind, found in [*sorted(kinds.items()), ("all", entries)]:
        size = sum(entry.size for entry in found) / 1e6
        last = max((entry.read for entry in found), default=None)
        age = "-" if last is None else f"{max(0.0, now - last) / DAY:.1f} days"
        lines.append(ROW.format(kind, len(found), f"{size:.1f}", age))
    return lines


if __name__ == "__main__":
    main()
