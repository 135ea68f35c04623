"""How far a search has come: all that it needs to go on after its last finished round."""

from __future__ import annotations

from dataclasses import dataclass, replace

from bayesoleo.tracing.deciding.rounds import Round
from bayesoleo.tracing.deciding.state import State
from bayesoleo.tracing.errors.same_noise import least_noise


@dataclass(frozen=True)
class Progress:
    """A search between two rounds.

    Parameters
    ----------
    first, state : State
        The model as declared, and with the effects that the finished rounds added.
    rounds : tuple of Round
        Those that are finished.
    notes : tuple of str
        What a reader should know so far.
    broken : bool
        Whether it ended before a round found nothing more, or before its final effects had been
        looked at again.
    """

    first: State
    state: State
    rounds: tuple[Round, ...] = ()
    notes: tuple[str, ...] = ()
    broken: bool = False

    @property
    def finished(self) -> bool:
        """Whether the last round accepted nothing, so that no other follows."""
        return bool(self.rounds) and self.rounds[-1].after is None

    def with_same_noise(self) -> Progress:
        """With the errors of all states held against the noise that was found last: it is that of
        the records, and no round has another."""
        noise = self.state.errors.record_noise
        for entry in self.rounds:
            noise = least_noise(noise, entry.before.errors.record_noise)
        known: dict[int, State] = {}

        def same(state: State) -> State:
            return known.setdefault(id(state), state.with_noise(noise))

        rounds = tuple(
            replace(
                entry,
                before=same(entry.before),
                after=None if entry.after is None else same(entry.after),
            )
            for entry in self.rounds
        )
        return replace(self, first=same(self.first), state=same(self.state), rounds=rounds)

    def after(self, outcome: Round, state: State, notes: list[str]) -> Progress:
        """With one more round."""
        return Progress(self.first, state, (*self.rounds, outcome), tuple(notes))

    def ended(self, reason: str) -> Progress:
        """Broken off: with a last round that examined nothing and accepts nothing, where there is
        none. After the last round effects are still looked at again, so that one that has it may
        break off too.

        Parameters
        ----------
        reason : str
            Why the search went no further.
        """
        if self.finished:
            return replace(self, broken=True)
        last = Round(self.state, (), {}, None, None, reason, 1.0)
        return replace(self, rounds=(*self.rounds, last), broken=True)
