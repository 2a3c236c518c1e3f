"""What hangs on a site alone, and is asked for at every epoch, is worked out once for each."""

from collections.abc import Callable
from functools import wraps
from typing import TypeVar
from weakref import WeakKeyDictionary

from magfusion.model.site import Site

Found = TypeVar("Found")


def once_a_site(find: Callable[[Site], Found]) -> Callable[[Site], Found]:
    """Return a function that keeps what it returns for a site as long as that lives.

    What is returned must not be changed, nor refer to the site.  What is refused is not kept.
    """
    kept: WeakKeyDictionary[Site, Found] = WeakKeyDictionary()

    @wraps(find)
    def known(site: Site) -> Found:
        try:
            return kept[site]
        except KeyError:
            found = kept[site] = find(site)
            return found

    return known
