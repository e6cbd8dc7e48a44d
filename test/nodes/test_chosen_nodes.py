"""Which nodes the words of `thinmap` choose."""

from thinmap_ros.nodes.thinmap import chosen_nodes


def test_the_page_comes_beside_the_others():
    usual = chosen_nodes([])
    assert 'localizer' in usual and 'web' not in usual
    assert chosen_nodes(['web:=true']) == [*usual, 'web']
    assert chosen_nodes(['localizer', 'web:=true']) == ['localizer', 'web']
    assert chosen_nodes(['web']) == ['web']
    assert chosen_nodes(['web:=false']) == usual
