"""Show many runs on one page: `python -m src.report runs=<folder>`."""

from __future__ import annotations

import logging
from pathlib import Path

from meshspiral.data.files import write_file
from meshspiral.experiment.entry import entry_point
from meshspiral.experiment.schema import ReportConfig

log = logging.getLogger(__name__)


@entry_point("report", ReportConfig)
def main(config: ReportConfig) -> None:
    from meshspiral.reporting.groups import group_runs
    from meshspiral.reporting.page import page_html
    from meshspiral.reporting.plots import write_plots
    from meshspiral.reporting.runs import common_folder, read_runs
    from meshspiral.reporting.scenes import scenes_of
    from meshspiral.reporting.tables import write_tables

    runs, omitted = read_runs(config.runs)
    for reason in omitted:
        log.warning("omitted: %s", reason)
    groups = group_runs(runs)
    folder = Path(config.output) if config.output else common_folder(config.runs) / "report"
    folder.mkdir(parents=True, exist_ok=True)
    plots = write_plots(groups, folder)
    write_tables(groups, folder)
    scenes, notes = scenes_of(runs, config.shapes)
    for group in groups:
        if len(group.seeds) < len(group.runs):
            notes.append(f"{group.label()}: several runs have the same seed")
    for note in notes:
        log.warning("%s", note)
    write_file(folder / "index.html", page_html(groups, omitted, plots, scenes, notes))
    log.info("Runs:    %d, %d omitted", len(runs), len(omitted))
    log.info("Report:  %s", folder / "index.html")


if __name__ == "__main__":
    main()
