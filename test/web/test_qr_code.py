"""A code in the terminal is read as a camera reads it."""

import cv2
import numpy as np
import pytest

from thinmap_ros.web.access import Tokens, links, qr_code, reached_host

# Of each character, whether its upper and its lower half are light.
HALVES = {'█': (1, 1), '▀': (1, 0), '▄': (0, 1), ' ': (0, 0)}


def read(text):
    """What a camera reads from the lines of a terminal, light on dark."""
    halves = np.array([[HALVES[letter] for letter in line] for line in text.splitlines()])
    light = halves.transpose(0, 2, 1).reshape(-1, halves.shape[1])
    image = np.kron(light, np.full((8, 8), 255)).astype(np.uint8)
    return cv2.QRCodeDetector().detectAndDecode(image)[0]


@pytest.mark.parametrize('link', ['http://192.168.1.7:8480/#abcdefghijklmnopqrstuv', 'http://a/'])
def test_the_code_is_the_link(link):
    assert read(qr_code(link)) == link
    coloured = qr_code(link, has_colours=True)
    assert read(coloured.replace('\033[97;40m', '').replace('\033[0m', '')) == link


def test_the_links_have_an_address_that_others_can_open():
    tokens = Tokens('s' * 20, 'w' * 20)
    assert links('http://10.0.0.5:8480/', tokens) == {
        'steer': f'http://10.0.0.5:8480/#{"s" * 20}',
        'watch': f'http://10.0.0.5:8480/#{"w" * 20}',
    }
    assert reached_host('10.0.0.5') == '10.0.0.5'
    # Of this machine, whichever that is.
    assert reached_host('0.0.0.0').count('.') == 3 and reached_host('::')
