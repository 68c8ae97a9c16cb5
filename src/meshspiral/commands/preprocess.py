"""Fill the cache for a data set: `python -m src.preprocess data=bodies_6890`."""

from __future__ import annotations

import logging
import time

from meshspiral.experiment.entry import entry_point
from meshspiral.experiment.schema import PreprocessConfig

log = logging.getLogger(__name__)


@entry_point("preprocess", PreprocessConfig)
def main(config: PreprocessConfig) -> None:
    from meshspiral.data.pool import on_cluster
    from meshspiral.data.sources import open_data

    data = open_data(config)
    splits = [split for split, names in data.shapes.names.items() if names]
    began = time.perf_counter()
    with on_cluster(config.scheduler):
        data.prepare(splits, visit=True)
    data.reference.prepare()
    seconds = time.perf_counter() - began
    meshes = sum(len(data.datasets[split]) for split in splits)
    size = data.cache.size() / 1e6
    log.info(
        "%d meshes prepared in %.1f s; cache %s: %.0f MB", meshes, seconds, data.cache.root, size
    )


if __name__ == "__main__":
    main()
