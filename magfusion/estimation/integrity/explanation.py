"""What would explain a log that contradicts its declaration, and how well."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from math import isfinite

from scipy.special import expit

from magfusion.model.site import Site

MIN_DECREASE = 60.0  # of chi square, that an explanation must bring
CLEARLY = 2.5  # times smaller than before must chi square be, and than with any other cause
SIGNIFICANT = 60.0  # fall for each estimated parameter, in units of the remaining mean square
PENALTY = 6.0  # of chi square, for each estimated parameter
ENOUGH = 1.5  # times the degrees of freedom: the rest where all is explained
# Survey errors may leave more than noise: this share of chi square before, but not more than errors
# twice as large as declared (in chi square, times expected), or this share of a gross mistake's.
LITTLE, MAX_LEFT, VERY_LITTLE = 0.04, 4.0, 0.004
SIMILAR = 1.5  # times the chi square of another, that explains as well
MARGIN = 20.0  # of chi square, over any other cause
EQUAL = 1.0  # of chi square, which two answers of one kind may differ by


@dataclass(frozen=True)
class Explanation:
    """One thing that people get wrong, tried on a log."""

    code: str  # of `magfusion.model.trust.CODES`
    # cause, remedy: clauses: what is wrong, and what to do
    cause: str
    remedy: str
    # before, after: chi square as declared, and with this explanation
    before: float
    after: float
    expected: float  # degrees of freedom
    parameter_count: int = 0  # that were estimated for it
    beacon: str = ""  # the one beacon in which the mistake is; empty of any other mistake
    # whether it localises a fault without a reason: so it explains whatever is wrong
    # there, and is no rival of one with a reason
    catch_all: bool = False
    site: Site | None = None  # in which the mistake is corrected, where it can be
    # another site that explains the motion as well, of the same code: tried where this one fails
    rival: "Explanation | None" = None

    @property
    def score(self) -> float:
        """Chi square, with a price for each estimated parameter."""
        return self.after + PENALTY * self.parameter_count

    @property
    def fall(self) -> float:
        """By how much chi square falls, less that price."""
        return self.before - self.score

    @property
    def rival_probability(self) -> float:
        """Probability of the rival; a half where it is not known."""
        return 0.5 if self.rival is None else float(expit(0.5 * (self.after - self.rival.after)))

    @property
    def clear(self) -> bool:
        """Whether it explains enough to be reported."""
        by_survey = min(LITTLE * self.before, MAX_LEFT * self.expected)
        by_noise, of_gross = ENOUGH * self.expected, VERY_LITTLE * self.before
        enough = self.after < max(by_noise, by_survey, of_gross)
        # A bias or a lever arm that its prior holds back costs little, however certain it is.
        noise = max(self.after / max(self.expected, 1.0), 1e-9)
        significant = (
            self.parameter_count > 0 and self.fall / self.parameter_count > SIGNIFICANT * noise
        )
        clearly = self.before > CLEARLY * self.after or significant
        return enough and self.fall > MIN_DECREASE and clearly

    def as_well_as(self, other: "Explanation") -> bool:
        """Return whether it leaves hardly more than another, or no more than is expected."""
        return self.after < max(SIMILAR * other.after + MIN_DECREASE / 2.0, self.expected)

    def is_ambiguous_with(self, other: "Explanation") -> bool:
        """Return whether another would be another answer."""
        if other.catch_all and not self.catch_all:
            return self.beacon not in ("", other.beacon)
        return other.code != self.code

    def text(self, of: str) -> str:
        """Return the sentences that state it, with the evidence."""
        cause = self.cause[:1].upper() + self.cause[1:]
        return (
            f"{cause}. With that, the chi square of {of} falls from {self.before:.4g} to"
            f" {self.after:.3g} (at most {self.expected:.3g} expected). {self.remedy}"
        )


def clearly_best(tried: Iterable[Explanation]) -> Explanation | None:
    """Return the explanation that is better than those of any other code, if there is one.

    What leaves out all that is wrong has the smallest chi square there can be: a mistake that
    explains as much, and names the reason, is the better explanation.  Of one code, the first of
    those that explain equally much is the most common.
    """
    every = [one for one in tried if isfinite(one.score)]  # without one if it has no solution
    ranked = sorted(every, key=lambda one: one.score)
    if not ranked:
        return None
    least = ranked[0]
    equal = (one for one in every if one.code == least.code and one.score < least.score + EQUAL)
    best = next(equal)
    if best is not least and best.rival is None:
        best = replace(best, rival=least)
    if best.catch_all:
        named = (one for one in ranked if not one.catch_all and one.clear and one.as_well_as(best))
        best = next(named, best)
    if not best.clear:
        return None
    rival = next((one for one in ranked if best.is_ambiguous_with(one)), None)
    if rival is None or rival.score - best.score > max(MARGIN, 0.2 * best.score):
        return best
    return None
