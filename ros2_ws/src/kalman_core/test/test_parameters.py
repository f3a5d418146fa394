# SPDX-License-Identifier: Apache-2.0
import array
import dataclasses
import math

import numpy as np
import pytest
import yaml

from kalman_core.parameters import (
    ParameterError,
    allowed,
    build,
    coerce,
    default_yaml,
    markdown_table,
    parameter,
)


@dataclasses.dataclass(frozen=True, slots=True)
class Params:
    """Every kind of field."""

    noise: float = parameter(5e-3, 'white noise', unit='rad/s', minimum=0.0, maximum=1.0, live=True)
    rate: int = parameter(100, 'samples a second', unit='Hz', minimum=1)
    offset: float = parameter(-1e-6, 'anything goes')
    ceiling: float = parameter(1e16, 'no lower bound', maximum=1234567.0 * 1e10)
    tiny: float = parameter(2.5e-7, 'mantissa with a point')
    enabled: bool = parameter(True, 'on or off')
    variant: str = parameter('published', 'which equations', choices=('published', 'corrected'))
    frame: str = parameter("ship's base", 'frame id')
    arm: tuple = parameter((1.0, 2e-7, -3.0), 'lever arm', unit='m', minimum=-10.0, maximum=10.0)


FIELDS = {field.name: field for field in dataclasses.fields(Params)}


def test_a_declaration_carries_default_and_metadata():
    assert Params().noise == 5e-3
    meta = FIELDS['noise'].metadata
    assert (meta['unit'], meta['min'], meta['max'], meta['live']) == ('rad/s', 0.0, 1.0, True)
    assert FIELDS['rate'].metadata['live'] is False
    assert FIELDS['variant'].metadata['choices'] == ('published', 'corrected')
    assert FIELDS['frame'].metadata['text'] == 'frame id'


def test_building_from_nothing_gives_the_defaults_and_values_replace_them():
    assert build(Params, {}) == Params()
    built = build(Params, {'noise': 0.5, 'variant': 'corrected', 'enabled': False})
    assert built == dataclasses.replace(Params(), noise=0.5, variant='corrected', enabled=False)


@pytest.mark.parametrize(
    ('name', 'value', 'expected'),
    [
        ('noise', 1, 1.0),
        ('noise', np.float32(0.5), 0.5),
        ('noise', 0.0, 0.0),
        ('noise', 1.0, 1.0),
        ('rate', 200.0, 200),
        ('rate', np.int64(7), 7),
        ('rate', 1, 1),
        ('frame', '', ''),
        ('arm', [1, 2, 3], (1.0, 2.0, 3.0)),
        ('arm', array.array('d', [1.5, -10.0, 10.0]), (1.5, -10.0, 10.0)),
        ('arm', np.zeros(3), (0.0, 0.0, 0.0)),
    ],
)
def test_values_are_taken_as_the_type_of_the_default(name, value, expected):
    got = coerce(FIELDS[name], value)
    assert got == expected
    assert type(got) is type(expected)


@pytest.mark.parametrize(
    ('name', 'value', 'message'),
    [
        ('noise', -1, "parameter 'noise' is -1, allowed: 0 … 1 rad/s"),
        ('noise', 1.0000001, "parameter 'noise' is 1.0000001, allowed: 0 … 1 rad/s"),
        ('noise', math.nan, "parameter 'noise' is nan, allowed: 0 … 1 rad/s"),
        ('offset', math.inf, "parameter 'offset' is inf, allowed: any"),
        ('offset', 10**400, "parameter 'offset' is inf, allowed: any"),
        ('noise', '0.5', "parameter 'noise' is '0.5', expected float"),
        ('noise', True, "parameter 'noise' is True, expected float"),
        ('noise', None, "parameter 'noise' is None, expected float"),
        ('noise', [0.5], "parameter 'noise' is [0.5], expected float"),
        ('rate', 0, "parameter 'rate' is 0, allowed: >= 1 Hz"),
        ('rate', 1.5, "parameter 'rate' is 1.5, expected a whole number"),
        ('rate', math.inf, "parameter 'rate' is inf, allowed: >= 1 Hz"),
        ('rate', math.nan, "parameter 'rate' is nan, allowed: >= 1 Hz"),
        ('rate', False, "parameter 'rate' is False, expected int"),
        ('ceiling', 1e20, "parameter 'ceiling' is 1e+20, allowed: <= 1.234567e+16"),
        ('enabled', 1, "parameter 'enabled' is 1, expected true or false"),
        ('variant', 'other', "parameter 'variant' is 'other', allowed: published | corrected"),
        ('variant', 3, "parameter 'variant' is 3, allowed: published | corrected"),
        ('frame', 3, "parameter 'frame' is 3, allowed: a string"),
        ('arm', 'abc', "parameter 'arm' is 'abc', expected a list of numbers"),
        ('arm', b'abc', "parameter 'arm' is b'abc', expected a list of numbers"),
        ('arm', 5.0, "parameter 'arm' is 5.0, expected a list of numbers"),
        ('arm', np.array(5.0), "parameter 'arm' is array(5.), expected a list of numbers"),
        ('arm', [], "parameter 'arm' is [], expected a list of numbers"),
        ('arm', [1.0, 2.0], "parameter 'arm' has 2 elements, expected 3"),
        ('arm', [1.0, 2.0, 11.0], "parameter 'arm' is 11, allowed: -10 … 10 m"),
        ('arm', [1.0, math.nan, 1.0], "parameter 'arm' is nan, allowed: -10 … 10 m"),
        ('arm', [1.0, 'x', 1.0], "parameter 'arm' is 'x', expected float"),
    ],
)
def test_a_bad_value_is_refused_with_the_name_the_value_and_what_is_allowed(name, value, message):
    with pytest.raises(ParameterError) as caught:
        coerce(FIELDS[name], value)
    assert str(caught.value) == message
    assert isinstance(caught.value, ValueError)


def test_an_unknown_name_is_refused_with_the_known_ones():
    with pytest.raises(ParameterError, match="unknown parameter 'nosie'; known: noise, rate, offset"):
        build(Params, {'nosie': 1.0, 'noise': 0.1})


def test_rules_across_fields_stand_in_post_init():
    @dataclasses.dataclass(frozen=True)
    class Band:
        low: float = parameter(0.0, 'low')
        high: float = parameter(1.0, 'high')

        def __post_init__(self):
            if self.low >= self.high:
                raise ParameterError("parameter 'low' must be below 'high'")

    with pytest.raises(ParameterError, match="'low' must be below"):
        build(Band, {'low': 2.0})


@pytest.mark.parametrize(
    ('name', 'words'),
    [
        ('noise', '0 … 1 rad/s'),
        ('rate', '>= 1 Hz'),
        ('offset', 'any'),
        ('ceiling', '<= 1.234567e+16'),
        ('variant', 'published | corrected'),
    ],
)
def test_the_allowed_range_is_put_into_words(name, words):
    assert allowed(FIELDS[name]) == words


def test_plain_dataclass_fields_are_taken_too():
    @dataclasses.dataclass
    class Plain:
        gain: float = 2.0
        name: str = 'x'

    assert build(Plain, {'gain': 3}) == Plain(3.0, 'x')
    assert allowed(dataclasses.fields(Plain)[0]) == 'any'
    assert '| `gain` | `2.0` | – | any | restart |  |' in markdown_table(Plain)
    assert yaml.safe_load(default_yaml(Plain, 'n'))['n']['ros__parameters'] == {'gain': 2.0, 'name': 'x'}


def test_the_table_has_one_row_a_parameter_in_order_and_escapes_bars():
    rows = markdown_table(Params).splitlines()
    assert rows[0] == '| parameter | default | unit | allowed | live | meaning |'
    assert rows[1] == '|---|---|---|---|---|---|'
    assert rows[2] == '| `noise` | `0.005` | rad/s | 0 … 1 rad/s | yes | white noise |'
    assert rows[3] == '| `rate` | `100` | Hz | >= 1 Hz | restart | samples a second |'
    assert rows[8] == '| `variant` | `published` | – | published \\| corrected | restart | which equations |'
    assert rows[10] == '| `arm` | `[1.0, 2e-07, -3.0]` | m | -10 … 10 m | restart | lever arm |'
    assert len(rows) == 2 + len(FIELDS)


def test_the_default_yaml_reads_back_as_the_defaults_with_their_types():
    text = default_yaml(Params, 'filter_node')
    values = yaml.safe_load(text)['filter_node']['ros__parameters']
    assert list(values) == list(FIELDS)
    assert build(Params, values) == Params()
    for name, value in values.items():
        default = getattr(Params(), name)
        assert type(value) is (list if name == 'arm' else type(default)), name
    assert all(type(item) is float for item in values['arm'])


def test_each_line_of_the_default_yaml_is_commented_with_text_and_unit():
    lines = default_yaml(Params, 'filter_node').splitlines()
    assert lines[0] == '# SPDX-License-Identifier: Apache-2.0'
    assert lines[1] == 'filter_node:'
    assert lines[2] == '  ros__parameters:'
    assert lines[3] == '    noise: 0.005  # white noise [rad/s]'
    assert lines[5] == '    offset: -1.0e-06  # anything goes'
    assert lines[7] == '    tiny: 2.5e-07  # mantissa with a point'
    assert lines[8] == '    enabled: true  # on or off'
    assert lines[10] == "    frame: 'ship''s base'  # frame id"
    assert lines[11] == '    arm: [1.0, 2.0e-07, -3.0]  # lever arm [m]'
    assert yaml.safe_load(default_yaml(dataclasses.make_dataclass('Off', [('x', bool, False)]), 'n')) == {
        'n': {'ros__parameters': {'x': False}}
    }
