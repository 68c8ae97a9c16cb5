"""Test a finished run again: `python -m src.evaluate run=<run folder>`."""

from __future__ import annotations

import logging
import time
from pathlib import Path

from meshspiral.experiment.entry import entry_point
from meshspiral.experiment.run_folder import BEST, ERRORS, METRICS, RunError, write_metrics
from meshspiral.experiment.schema import EvaluateConfig

log = logging.getLogger(__name__)


@entry_point("evaluate", EvaluateConfig)
def main(config: EvaluateConfig) -> None:
    from meshspiral.evaluation import retest, summary
    from meshspiral.evaluation.outcome import json_ready
    from meshspiral.training.checkpoints import config_of, read_checkpoint, template_of
    from meshspiral.training.device import set_up_process
    from meshspiral.training.predictor import Predictor

    set_up_process(config.threads)
    run, requested = Path(config.run), config.data or {}
    if not run.is_dir():
        raise RunError(f"run={run} is not a folder")
    saved = read_checkpoint(run / BEST)
    trained = config_of(saved, str(run))
    if not (run / METRICS).is_file():
        epoch, epochs = saved["epoch"] + 1, trained.optim.epochs
        log.warning(
            "%s is not finished: this is its best checkpoint so far, epoch %d of %d",
            run,
            epoch,
            epochs,
        )
    settings = retest.config_on_data(trained, requested)
    retest.check_random("rotations", config.rotations, settings, least=0)
    retest.check_random("votes", config.votes, settings, least=1)
    predict = Predictor(saved, settings, config.accelerator, config.votes)
    data = retest.open_test_data(settings, template_of(saved), requested)
    chosen = retest.choose_shapes(config.shapes, data.shapes.names["test"])

    data.reference.prepare()  # not part of the seconds per mesh
    began = time.perf_counter()
    outcome = retest.evaluate(predict, data)
    seconds = (time.perf_counter() - began) / len(outcome.names)
    values, curve = outcome.metrics()
    metrics = json_ready(values, "test")
    folder = retest.create_folder(run, settings, trained, config.votes)
    outcome.save(folder / ERRORS)
    for line in summary.metric_lines(outcome, metrics):
        log.info(line)
    draws = f", {config.votes} votes" if config.votes > 1 else ""
    log.info("Seconds:     %.2f per mesh%s", seconds, draws)
    curves = {"test": curve}
    if config.points:
        errors = retest.evaluate_points(predict.distributions, data, outcome)
        values, curves["points"] = retest.point_metrics(errors)
        metrics |= json_ready(values, "points")
        for line in retest.point_lines(values):
            log.info(line)
    if config.rotations:
        found = retest.evaluate_rotations(predict, data, config.rotations)
        metrics |= json_ready(found.metrics(), "rotations")
        retest.write_rotations(folder, found)
        for line in retest.rotation_lines(found):
            log.info(line)
    write_metrics(folder, metrics)
    summary.write_plots(folder, curves, outcome, data, chosen, retest.KINDS)
    log.info("Written to:  %s", folder)


if __name__ == "__main__":
    main()
