"""All mistakes of `mistakes` by name, and the case without one."""

import mistakes_changing
import mistakes_of_aiding
import mistakes_of_data
import mistakes_of_instruments
import mistakes_of_site
import mistakes_of_world
from mistake_case import Mistake

GOOD = Mistake("good", "none", lambda case: case, harmless=True)
MISTAKES = {
    mistake.name: mistake
    for part in (
        mistakes_of_site,
        mistakes_of_data,
        mistakes_of_world,
        mistakes_changing,
        mistakes_of_instruments,
        mistakes_of_aiding,
    )
    for mistake in part.MISTAKES
}
