"""Search for hyperparameters with Optuna: each trial is a run of `vjepa2-ac train` in a folder of its own.

    pip install optuna==5.0.0
    python examples/sweeps/optuna_sweep.py FOLDER TRIALS CONFIG [key=value ...]
    for run in FOLDER/*/; do vjepa2-ac evaluate "$run"; done
    vjepa2-ac compare FOLDER/*/

TRIALS is the total number of trials. Started again, the study continues, and a stopped trial resumes its run. Only one
process may use a FOLDER at a time. METRIC is a column of RUN/metrics.jsonl; a trial's value is that of the selected
checkpoint.
"""

import sys
from pathlib import Path

import optuna
from optuna.distributions import CategoricalDistribution, FloatDistribution
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend
from optuna.trial import TrialState

from vjepa2_ac import load_config, train
from vjepa2_ac.cli import main as vjepa2_ac
from vjepa2_ac.errors import InputError
from vjepa2_ac.process import EXIT_STATUS, StoppedError
from vjepa2_ac.runs.checkpoint import parse_step, select_checkpoint
from vjepa2_ac.runs.folder import METRICS
from vjepa2_ac.runs.metrics_log import read_metrics_log

METRIC = "action_ranking_error"  # lower is better; another is rollout_over_persistence_last
SPACE = {  # the search space; any config keys
    "training.learning_rate": FloatDistribution(1e-5, 1e-3, log=True),
    "adapter.rank": CategoricalDistribution([8, 16, 32]),
}


def main(study_folder: str, trials: str, *config: str) -> None:
    """Run trials until the study has the given number of trials."""
    folder = Path(study_folder)
    folder.mkdir(parents=True, exist_ok=True)
    if status := vjepa2_ac(["train", *config, f"run_dir={folder / 'check'}", "--check"]):
        sys.exit(status)
    storage = JournalStorage(JournalFileBackend(str(folder / "study.journal")))
    study = optuna.create_study(storage=storage, study_name=METRIC, load_if_exists=True)
    open_trials = study.get_trials(states=[TrialState.RUNNING])
    while open_trials or len(study.trials) < int(trials):
        trial = open_trials.pop(0) if open_trials else study.ask(SPACE)
        run = folder / f"{trial.number:03}"
        overrides = [f"{key}={value}" for key, value in trial.params.items()]
        try:
            train(load_config(config[0], [*config[1:], *overrides, f"run_dir={run}"]), note=print)
        except InputError as error:  # an invalid config or a non-finite loss; after an outage the trial stays open
            print(f"trial {trial.number}: {error}")
            study.tell(trial.number, state=TrialState.FAIL)
        except StoppedError:
            sys.exit(EXIT_STATUS)
        else:
            step = parse_step(select_checkpoint(run).path.name)
            rows = [row for row in read_metrics_log(run / METRICS) if METRIC in row and row["step"] <= step]
            study.tell(trial.number, rows[-1][METRIC])
    print(f"{METRIC} {study.best_value:.4f} in {folder / f'{study.best_trial.number:03}'}: {study.best_params}")


if __name__ == "__main__":
    main(*sys.argv[1:])
