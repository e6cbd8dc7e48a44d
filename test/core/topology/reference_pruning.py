"""Reference simplification of a skeleton graph, slow and simple, with chain objects."""

import math

import numpy as np

from thinmap_ros.core.topology.skeleton_graph import Chain, Spot, path_length


def backwards(chain):
    return Chain(chain.b, chain.a, chain.cells[::-1].copy(), chain.squared[::-1].copy())


def from_spot(chain, spot):
    return chain if spot == chain.a else backwards(chain)


def joined(one, two):
    cells = np.concatenate((one.cells, two.cells[1:]))
    return Chain(one.a, two.b, cells, np.concatenate((one.squared, two.squared[1:])))


def among(web, spots):
    return sorted({number for spot in spots if spot in web.spots for number in web.chains_at(spot)})


def dissolve(web, spots):
    for spot in sorted(spot for spot in spots if spot in web.spots and web.degree(spot) == 2):
        first, second = web.chains_at(spot)
        if first == second:
            continue
        one = web.chains[first]
        two = web.chains[second]
        web.drop_chain(first)
        web.drop_chain(second)
        web.drop_spot(spot)
        web.add_chain(joined(one if one.b == spot else backwards(one), from_spot(two, spot)))


def merge(web, number, kept):
    way = from_spot(web.chains[number], kept)
    gone = way.b
    web.drop_chain(number)
    for other in dict.fromkeys(web.chains_at(gone)):
        moved = web.chains[other]
        web.drop_chain(other)
        moved = joined(way, moved) if moved.a == gone else moved
        moved = joined(moved, backwards(way)) if moved.b == gone else moved
        web.add_chain(moved)
    web.drop_spot(gone)


def simplify(web, spots, promising, limits):
    dissolve(web, spots)
    while drop_spurs(web, spots, promising, limits):
        pass
    merge_close(web, spots, limits.join)
    drop_hollow(web, spots, limits.radius)
    dissolve(web, spots)
    move_rings(web, spots)


def merge_close(web, spots, limit):
    for length, number in sorted((path_length(web.chains[n].cells), n) for n in among(web, spots)):
        chain = web.chains.get(number)
        if (
            chain is None
            or length > limit
            or chain.a == chain.b
            or min(map(web.degree, chain.ends)) < 3
        ):
            continue
        web_spots = web.spots[chain.a], web.spots[chain.b]
        merge(web, number, chain.a if web_spots[0].squared >= web_spots[1].squared else chain.b)


def area(ring):
    rows, cols = ring.T
    return abs(float(rows @ np.roll(cols, -1) - cols @ np.roll(rows, -1))) / 2.0


def drop_hollow(web, spots, radius):
    least = max(math.pi * (radius - 0.5) ** 2, 1.0)
    kept = {}
    for number in sorted(among(web, spots), key=lambda n: (path_length(web.chains[n].cells), n)):
        chain = web.chains[number]
        beside = kept.setdefault(frozenset(chain.ends), [])
        ways = (
            [from_spot(other, chain.b).cells for other in beside]
            if chain.a != chain.b
            else [chain.cells[:1]]
        )
        if any(area(np.concatenate((chain.cells, way[1:]))) < least for way in ways):
            web.drop_chain(number)
        else:
            beside.append(chain)


def drop_spurs(web, spots, promising, limits):
    gone = []
    for number in among(web, spots):
        chain = web.chains[number]
        tips = [spot for spot in chain.ends if web.degree(spot) == 1]
        if not tips:
            continue
        tip = min(tips, key=lambda spot: web.spots[spot].squared)
        base = chain.other(tip)
        tip_room, base_room = (
            math.sqrt(web.spots[spot].squared) - limits.radius for spot in (tip, base)
        )
        adds = path_length(chain.cells) + tip_room - base_room
        seen = adds <= limits.min_branch_ratio * base_room and not promising(web.spots[tip])
        if adds <= limits.spur or seen:
            gone.append((number, tip, base))
        elif not gone and adds_nothing(web, number, base, limits.radius):
            gone.append((number, tip, base))
            break
    for number, tip, _ in gone:
        web.drop_chain(number)
        web.drop_spot(tip)
    dissolve(web, {base for _, _, base in gone})
    return bool(gone)


def adds_nothing(web, number, base, radius):
    near = {spot for other in web.chains_at(base) for spot in web.chains[other].ends}
    others = [web.chains[other] for other in among(web, near) if other != number]
    if not others:
        return False
    cells = np.concatenate([chain.cells for chain in others])
    room = np.sqrt(np.concatenate([chain.squared for chain in others])) - radius
    squared = ((web.chains[number].cells[:, None] - cells) ** 2).sum(axis=2)
    return bool(((squared <= room**2) & (room >= 0.0)).any(axis=1).all())


def move_rings(web, spots):
    for number in among(web, spots):
        chain = web.chains[number]
        if chain.a != chain.b or web.degree(chain.a) != 2:
            continue
        middle = (chain.cells.min(axis=0) + chain.cells.max(axis=0)) / 2.0
        distance = np.hypot(*(chain.cells[:-1] - middle).T)
        start = min(
            np.flatnonzero(distance >= distance.max() - 2.0), key=lambda k: tuple(chain.cells[k])
        )
        last = len(chain.cells) - 1
        web.drop_chain(number)
        web.move_spot(chain.a, Spot(tuple(chain.cells[start].tolist()), int(chain.squared[start])))
        web.add_chain(joined(chain.part(start, last), chain.part(0, start)))
