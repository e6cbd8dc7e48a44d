"""Links between maps: where each lies, cycles of links, and links that cannot be right."""

import math

import numpy as np
import pytest

from thinmap_ros.core import se2
from thinmap_ros.core.slam.joining.team import MapLink, MapLinks

NEAR = np.diag([0.05**2, 0.05**2, 0.01**2])


def link(a, b, T, log_odds=20.0, covariance=NEAR):
    return MapLink(a, b, np.array(T, dtype=float), covariance, log_odds, 10)


def test_maps_lie_where_a_chain_of_links_leads():
    links = MapLinks()
    links.add(link('a', 'b', (2.0, 0.0, math.pi / 2)))
    links.add(link('c', 'b', (0.0, 3.0, 0.0)))
    links.add(link('x', 'y', (1.0, 1.0, 0.0)))
    places = links.places('a')
    assert set(places) == {'a', 'b', 'c'}
    np.testing.assert_allclose(places['c'], [5.0, 0.0, math.pi / 2], atol=1e-9)


def test_a_reversed_link_leads_back_with_the_error_of_its_lever():
    there = link('a', 'b', (10.0, 0.0, 0.0))
    back = there.reversed()
    np.testing.assert_allclose(se2.compose(there.T_a_b, back.T_a_b), 0.0, atol=1e-12)
    # An error of the heading moves what is 10 m away.
    assert back.covariance[1, 1] == pytest.approx(0.05**2 + (10.0 * 0.01) ** 2)


def test_a_cycle_shares_its_error():
    links = MapLinks()
    links.add(link('a', 'b', (1.0, 0.0, 0.0)))
    links.add(link('b', 'c', (1.0, 0.0, 0.0)))
    assert links.add(link('a', 'c', (2.06, 0.0, 0.0))) == []
    places = links.places('a')
    np.testing.assert_allclose(places['b'][:2], [1.02, 0.0], atol=1e-3)
    np.testing.assert_allclose(places['c'][:2], [2.04, 0.0], atol=1e-3)


@pytest.mark.parametrize('last', ['a b', 'b c', 'a c'])
def test_of_a_cycle_that_cannot_be_right_the_least_sure_link_is_dropped(last):
    cycle = {
        'a b': link('a', 'b', (1.0, 0.0, 0.0)),
        'b c': link('b', 'c', (1.0, 0.0, 0.0)),
        'a c': link('a', 'c', (4.0, 0.0, 0.0), log_odds=12.0),
    }
    links = MapLinks()
    order = [*(name for name in cycle if name != last), last]
    dropped = [lost for name in order for lost in links.add(cycle[name])]
    assert dropped == [cycle['a c']]
    assert {frozenset((each.a, each.b)) for each in links} == {frozenset('ab'), frozenset('bc')}


def test_what_a_person_gives_is_never_dropped():
    links = MapLinks()
    links.add(link('a', 'b', (1.0, 0.0, 0.0)))
    links.add(link('b', 'c', (1.0, 0.0, 0.0)))
    given = link('a', 'c', (9.0, 0.0, 0.0), log_odds=math.inf)
    (dropped,) = links.add(given)
    assert given in list(links) and dropped is not given


def test_removed_and_replaced_links_are_gone():
    links = MapLinks()
    first = link('a', 'b', (1.0, 0.0, 0.0))
    links.add(first)
    newer = link('a', 'b', (1.5, 0.0, 0.0))
    links.add(newer)
    assert not links.discard(first)
    assert links.between('a', 'b') is newer
    links.remove('b')
    assert list(links) == [] and set(links.places('a')) == {'a'}
