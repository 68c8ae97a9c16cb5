"""The share of training time that a network waits for meshes."""

from __future__ import annotations

import tempfile

import lightning as L

from meshspiral.benchmarking.measure import Row
from meshspiral.data.progress import Progress
from meshspiral.data.sources import open_data
from meshspiral.experiment.schema import BenchmarkConfig, TrainConfig
from meshspiral.training.callbacks import Speed
from meshspiral.training.device import choose_precision
from meshspiral.training.module import Correspondence
from meshspiral.training.trainer import quiet

MESHES = 10


def waiting_rows(config: BenchmarkConfig, networks: list[TrainConfig]) -> list[Row]:
    """A row for each network: seconds of one epoch on ten training bodies, read from the cache.

    Columns: "steps"; "seconds" of all of them; "waiting", what passes between two steps, when a
    mesh is read and its neighbourhoods are drawn; "waiting / seconds".
    """
    quiet()
    rows = []
    for network in Progress(networks, desc="Waiting"):
        with tempfile.TemporaryDirectory() as folder:
            data_settings = network.data.model_copy(update={"cache_dir": folder})
            network = network.model_copy(update={"data": data_settings})
            data = open_data(network)
            names = data.shapes.names["train"][:MESHES]
            data.shapes.names = {"train": names, "val": names[:1]}
            data.setup("fit")
            module = Correspondence(network.model_dump(), data.in_features, data.num_classes)
            speed = Speed()
            trainer = L.Trainer(
                accelerator="cpu",
                precision=choose_precision(config.precision, "cpu"),
                max_epochs=1,
                limit_val_batches=0,
                use_distributed_sampler=False,
                logger=False,
                enable_checkpointing=False,
                enable_progress_bar=False,
                enable_model_summary=False,
                callbacks=[speed],
            )
            trainer.fit(module, datamodule=data)
        rows.append(
            {
                "network": network.model.name,
                "steps": trainer.global_step,
                "seconds": speed.seconds,
                "waiting": speed.waiting,
                "waiting / seconds": speed.waiting / speed.seconds,
            }
        )
    return rows
