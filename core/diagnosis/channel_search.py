"""One channel: the search in its samples, the refit on all of them, and their validation."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from gapbridge.core.diagnosis.across_sessions import session_transfer
from gapbridge.core.diagnosis.all_rows.gap_sizes import gaps, sizes_of, streamed_sizes
from gapbridge.core.diagnosis.all_rows.refit_on_all_rows import (
    RefitsAtOnce,
    accused_on_all_rows,
    fitted_on_all_rows,
    with_undecided_terms,
    without_causes,
)
from gapbridge.core.diagnosis.all_rows.remaining_structure import (
    Depends,
    with_excess,
    with_whiteness,
)
from gapbridge.core.diagnosis.all_rows.row_sums import RowSums, Streamed
from gapbridge.core.diagnosis.causes import Cause, Considered, causes_of, considered_of
from gapbridge.core.diagnosis.channel_diagnosis import ChannelDiagnosis, Verdict, Where, locate
from gapbridge.core.diagnosis.criteria import UNRESOLVED
from gapbridge.core.diagnosis.generalisation import generalisation
from gapbridge.core.diagnosis.held_out import HeldOut
from gapbridge.core.diagnosis.judgement import (
    Judgement,
    judge,
    judge_geometry,
    significant_alone,
    with_stand_ins,
    with_structure_left,
)
from gapbridge.core.diagnosis.observation import Observation
from gapbridge.core.diagnosis.residual_structure import dependence
from gapbridge.core.diagnosis.selection.rounds import select
from gapbridge.core.diagnosis.selection.selection import Selection, refitted_alone
from gapbridge.core.diagnosis.value_stability import closes_gap
from gapbridge.core.effects import Term
from gapbridge.core.log.log import Log
from gapbridge.core.model import Model


@dataclass(frozen=True)
class SearchResult:
    """The result of a search in a channel's samples, before it is validated on all rows."""

    observation: Observation
    selection: Selection  # on all samples of the channel
    more: bool  # the selection has more samples than were searched
    judgement: Judgement
    # accused positions -> what the residual depends on in the samples that were searched
    depends: Callable[[Sequence[int]], Depends]
    where: Where
    considered: tuple[Considered, ...]
    stand_ins: tuple[Cause, ...]
    fitted_together: tuple[Term, ...]  # causes and stand-ins

    def without_columns(self) -> SearchResult:
        """Return the same without the columns of all candidates (50 MB)."""
        known = self.judgement.depends_on or self.depends(self.judgement.accused)
        return replace(self, depends=lambda _: known)

    def row_sums(self, observe: Callable[[Log], Any], model: Model) -> RowSums:
        """Return the sums over all rows of a long recording, linearised at the accused terms."""
        by_region = self.judgement.unnamed_part is not None
        return RowSums(self.selection, self.judgement.accused, observe, model.arm, by_region)


def _search(
    observation: Observation, model: Model, withhold: tuple[str, ...],
    progress: Callable[[str], None] | None,
) -> tuple[Selection, Judgement, tuple[Considered, ...]]:  # fmt: skip
    """Return a search's selection and judgement, and effects withdrawn in a previous search.

    If no cause remains, the withdrawn effects may have masked the causes. The search is repeated
    without them, and counts if its causes close the gap in every part of the log (an iiwa under
    three loads needed that for one of two sets of poses).
    """

    def judged(without: tuple[str, ...]) -> tuple[Selection, Judgement]:
        found = select(observation, model, without, progress)
        return judge_geometry(found, judge(found, HeldOut(found)), model.arm)

    first, judgement = judged(withhold)
    withdrawn_effects = {first.terms[p].effect for p, _ in judgement.withdrawn}
    unexplained = judgement.structured and not judgement.accused
    if not (unexplained and withdrawn_effects and observation.channel == "position"):
        return first, judgement, ()
    second, other = judged((*withhold, *withdrawn_effects))
    if not closes_gap(second, [second.term_index[p] for p in other.accused]):
        return first, judgement, ()
    considered = considered_of(first, judgement, HeldOut(first), withhold)
    return second, other, tuple(c for c in considered if c.effect in withdrawn_effects)


def search_and_refit(
    observation: Observation, whole: Observation, model: Model, withhold: tuple[str, ...],
    progress: Callable[[str], None] | None, streamed: bool = False,
) -> SearchResult:  # fmt: skip
    """Return the result of a search in ``observation``, refitted on all samples of ``whole``.

    ``streamed``: further rows follow block by block, which only the named terms are refitted on.
    """
    searched, judgement, withdrawn = _search(observation, model, withhold, progress)
    held_out = HeldOut(searched)
    judgement = with_stand_ins(searched, judgement)
    stand_ins = _stand_ins(searched, judgement, held_out, model)
    before = judgement
    searched, judgement = significant_alone(searched, judgement, held_out, model.arm)
    if judgement.accused != before.accused:
        judgement = with_structure_left(searched, judgement)
    without = (*withhold, *(c.effect for c in withdrawn))
    considered = (*considered_of(searched, judgement, held_out, without), *withdrawn)
    chosen = [searched.term_index[p] for p in judgement.accused]
    where = locate(searched, gaps(searched, chosen)[0][searched.kept], chosen)
    selection = searched
    more_rows = streamed or len(whole.rows) > len(observation.rows)
    if more_rows:
        judgement = with_undecided_terms(judgement)
    # the links' effects were judged together, where the position's geometry is one effect
    if more_rows or (searched.block and observation.channel != "position"):
        if progress:
            progress(f"{observation.channel}: all {len(whole.rows)} rows")
        selection = fitted_on_all_rows(searched, judgement, whole, model)

    def depends(accused: Sequence[int]) -> Depends:
        fitted = [searched.term_index[p] for p in accused]
        basis = searched.nuisance_basis
        return tuple(dependence(searched.space, basis, fitted, searched.groups))

    more = selection is not searched
    return SearchResult(
        observation, selection, more, judgement, depends, where, considered, *stand_ins
    )


def validated_diagnosis(
    searched: SearchResult, model: Model, streamed: Streamed | None
) -> ChannelDiagnosis:
    """Return the diagnosis validated on all rows; ``streamed`` are those of a long recording."""
    observation, final = searched.observation, searched.selection
    judgement = searched.judgement
    decided = final if streamed is None else streamed.selection(judgement.accused)
    held_out = HeldOut(decided)
    if searched.more or streamed is not None:
        unknown = judgement.unnamed_part is not None
        refits = RefitsAtOnce(model, unknown) if streamed is None else streamed
        decided, judgement = accused_on_all_rows(decided, judgement, held_out, refits)
    if streamed is None:
        final = decided
    else:
        final = replace(final, terms=decided.terms, covariance=decided.covariance)
    chosen = [decided.term_index[p] for p in judgement.accused]
    gap, remaining = gaps(final, chosen)
    if streamed is None:
        sizes = sizes_of(final, gap, remaining)
    else:
        sizes = streamed_sizes(streamed, decided, judgement.accused)
    if sizes.remaining_rms > sizes.gap_rms and judgement.accused:
        # terms of any size are compared to first order, at which their gain may be none
        judgement = without_causes(judgement, searched.depends(()))
        chosen, remaining = [], gap
        sizes = replace(sizes, remaining_rms=sizes.gap_rms)
    causes = causes_of(decided, judgement, held_out, model.arm)
    if searched.more and streamed is None:
        judgement = with_excess(judgement, final, remaining, searched.depends)
    judgement, floor = with_whiteness(judgement, final, sizes.means, searched.depends)
    held_out_rms = held_out.rms(chosen) if held_out.possible else None
    if not causes:  # only the frame was fitted
        held_out_rms = sizes.gap_rms
    if sizes.remaining_rms < UNRESOLVED:
        judgement = replace(judgement, structured=False, depends_on=())
    structured = judgement.structured
    verdict = Verdict.EXPLAINED if causes else Verdict.NO_GAP
    if structured:
        verdict = Verdict.PARTLY_EXPLAINED if causes else Verdict.UNEXPLAINED
    per_sample = held_out if streamed is None else HeldOut(final)
    return ChannelDiagnosis(
        channel=observation.channel, unit=observation.unit, samples=sizes.samples,
        gap_rms=sizes.gap_rms, gap_max=sizes.gap_max, noise_floor_rms=floor.rms,
        remaining_rms=sizes.remaining_rms, remaining_rms_held_out=held_out_rms,
        where=searched.where, causes=causes, considered=searched.considered,
        unexplained_rms=_unexplained(sizes.remaining_rms, floor.rms, judgement),
        structured=structured, p_value=judgement.p_value, depends_on=judgement.depends_on,
        verdict=verdict, selection=final, judgement=judgement, gap=gap, remaining=remaining,
        held_out=np.sqrt(per_sample.squares(chosen)) if per_sample.possible else None,
        outliers=sizes.outliers, generalisation=generalisation(decided, chosen),
        session_transfer=session_transfer(decided, chosen, model.arm),
        noise_floor_source=floor.source, stand_ins=searched.stand_ins,
        fitted_together=searched.fitted_together,
    )  # fmt: skip


def _stand_ins(
    selection: Selection, judgement: Judgement, held_out: HeldOut, model: Model
) -> tuple[tuple[Cause, ...], tuple[Term, ...]]:
    """Return the stand-ins as causes, and the terms of causes and stand-ins fitted together."""
    if not judgement.stand_ins:
        return (), ()
    both = (*judgement.accused, *judgement.stand_ins)
    together = refitted_alone(selection, model.arm, both)
    combined = replace(judgement, accused=both, ties={})
    marked = [replace(together.terms[p], stand_in=p in judgement.stand_ins) for p in both]
    return causes_of(together, combined, held_out, model.arm, judgement.stand_ins), tuple(marked)


def _unexplained(remaining: float, floor: float | None, judgement: Judgement) -> float:
    """Return the rms of the residual beyond the noise; 0 for a residual without structure.

    If the floor is unknown or not lower than the residual, the largest share that a quantity
    predicts is taken; without one, the whole residual.
    """
    if not judgement.structured:
        return 0.0
    beyond = float(np.sqrt(max(remaining**2 - floor**2, 0.0))) if floor is not None else 0.0
    if beyond > 0:
        return beyond
    share = max((share for _, share in judgement.depends_on), default=1.0)
    return remaining * float(np.sqrt(np.clip(share, 0.0, 1.0)))
