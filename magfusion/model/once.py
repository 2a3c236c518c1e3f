"""Cache, by site, of quantities that depend on the site alone and are needed at every epoch."""

from collections.abc import Callable
from functools import wraps
from typing import TypeVar
from weakref import WeakKeyDictionary

from magfusion.model.site import Site

Value = TypeVar("Value")


def once_a_site(find: Callable[[Site], Value]) -> Callable[[Site], Value]:
    """Return a function that caches its result for a site as long as the site lives.

    The result must not be modified, nor refer to the site.  Exceptions are not cached.
    """
    kept: WeakKeyDictionary[Site, Value] = WeakKeyDictionary()

    @wraps(find)
    def known(site: Site) -> Value:
        try:
            return kept[site]
        except KeyError:
            result = kept[site] = find(site)
            return result

    return known
