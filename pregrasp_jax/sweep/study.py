"""A search that learns from what was measured: optuna's TPE, asked and told by the driver (extra `sweep`)."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pregrasp_jax.sweep import state
from pregrasp_jax.sweep.parameters import Parameter, rounded
from pregrasp_jax.sweep.spec import Spec
from pregrasp_jax.sweep.state import TrialState
from pregrasp_jax.sweep.trials import make_trial

_MISSING = "search.method tpe needs optuna, which is not installed; allowed is pip install 'pregrasp_jax[sweep]'"


def require_optuna() -> Any:
    """Return the module.

    Raises:
        ValueError: it is not installed.
    """
    try:
        import optuna
    except ModuleNotFoundError:
        raise ValueError(_MISSING) from None
    return optuna


class Study:
    """What optuna knows of a sweep, in optuna.log; trials.jsonl is the truth, and what it lacks is forgotten here."""

    def __init__(self, folder: Path, spec: Spec):
        """Open or begin the study; `folder` is that of the sweep."""
        optuna = self._optuna = require_optuna()
        optuna.logging.set_verbosity(optuna.logging.WARNING)
        self._spec, self._exhausted = spec, False
        backend = optuna.storages.journal.JournalFileBackend(str(folder / "optuna.log"))
        storage = optuna.storages.JournalStorage(backend)
        self._study = optuna.create_study(
            study_name="sweep", storage=storage, direction="maximize", load_if_exists=True
        )
        # The state of a sampler is not stored; this one goes on differently after every proposal, and always alike.
        seed = spec.search.seed + 1000 * len(self._study.trials)
        self._study.sampler = optuna.samplers.TPESampler(seed=seed, constant_liar=True)

    def learn(self, states: Sequence[TrialState]) -> None:
        """Tell optuna what has ended since, and forget what it proposed in vain."""
        States = self._optuna.trial.TrialState
        members = {s.trial.proposal: [t for t in states if t.trial.proposal == s.trial.proposal] for s in states}
        for known in self._study.get_trials(states=(States.RUNNING,)):
            trials = members.get(known.number)
            if trials is None:
                self._study.tell(known.number, state=States.FAIL)
            elif all(s.over for s in trials):
                scores = [s.score for s in trials if s.score is not None]
                if len(scores) == len(trials):
                    self._study.tell(known.number, state.mean(scores))
                else:
                    self._study.tell(known.number, state=States.FAIL)

    def propose(self, states: Sequence[TrialState]) -> tuple[dict[str, Any] | None, int]:
        """Return a setting that was not tried yet and its number here; None when there were enough, or all."""
        groups = state.by_setting([s for s in states if not s.trial.final])
        if self._exhausted or len(groups) >= (self._spec.search.trials or 0):
            return None, -1
        for _ in range(100):
            asked = self._study.ask()
            setting = {name: _suggest(asked, name, parameter) for name, parameter in self._spec.parameters.items()}
            if make_trial(self._spec, setting, 0).group not in groups:
                return setting, asked.number
            self._study.tell(asked.number, state=self._optuna.trial.TrialState.FAIL)
        self._exhausted = True
        return None, -1


def _suggest(asked: Any, name: str, parameter: Parameter) -> Any:
    if parameter.kind == "values":
        index = asked.suggest_categorical(name, list(range(len(parameter.given))))
        return parameter.given[index]
    low, high = parameter.given
    if parameter.kind == "int":
        return asked.suggest_int(name, low, high)
    return rounded(asked.suggest_float(name, low, high, log=parameter.kind == "log"), low, high)
