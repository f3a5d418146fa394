# SPDX-License-Identifier: Apache-2.0
"""The report is one page that needs nothing from elsewhere, and says what the scores say."""

import os
import re
import shutil
import subprocess
from html.parser import HTMLParser

import numpy as np
import pytest
from bag_samples import IMU, MAG, MIX, SECOND, imu, mag, write_sensors
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.backends.backend_agg import FigureCanvasAgg

from bag_tools import report as tool
from bag_tools.bag import BagError, BagWriter, zeroed
from bag_tools.errors import quaternions
from bag_tools.figures import DARK, LIGHT, Line, Panel, broken, draw, short_names, spread, thin
from bag_tools.offline import offline
from bag_tools.report import (
    Chapter,
    NisTrace,
    RunResult,
    bag_names,
    diagnostics_of,
    nis_of,
    panels_of_nis,
    write_chapters,
    write_report,
)
from bag_tools.report_page import table
from bag_tools.score import evaluate
from bag_tools.series import Series


class Page(HTMLParser):
    """Checks that tags nest, and collects what matters."""

    def __init__(self):
        super().__init__()
        self.stack, self.references, self.tags, self.text = [], [], [], []

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.references += [v for k, v in attrs if k in ('src', 'href', 'xlink:href', 'data', 'action')]
        if tag not in ('meta', 'br'):
            self.stack.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.handle_starttag(tag, attrs)
        if tag not in ('meta', 'br'):
            self.stack.pop()

    def handle_endtag(self, tag):
        assert self.stack.pop() == tag

    def handle_data(self, data):
        self.text.append(data)


def parse(path):
    page = Page()
    page.feed(path.read_text(encoding='utf-8'))
    page.close()
    assert page.stack == []
    return page


def comparison(sigma, seed, n=3000):
    rng = np.random.default_rng(seed)
    stamps = SECOND + np.arange(n) * 10_000_000
    t = (stamps - SECOND) * 1e-9
    truth = np.column_stack((0.3 * np.sin(t), 0.1 * np.cos(0.7 * t), 0.1 * t))
    names = ('w', 'x', 'y', 'z')
    cov = np.tile(np.eye(3) * sigma**2, (n, 1, 1))
    estimate = quaternions(truth + sigma * rng.normal(size=(n, 3)))
    return evaluate(
        Series('orientation', 'orientation', stamps, estimate, names, 'rad', cov),
        Series('orientation', 'orientation', stamps, quaternions(truth), names, 'rad'),
    )


@pytest.fixture(scope='module')
def runs():
    trace = NisTrace(np.arange(30.0), np.linspace(1, 5, 30), np.full(30, 16.3))
    return [
        RunResult(
            f'Run <{k}> & co',
            {'attitude_estimator': [comparison(0.01, k)], 'paper': [comparison(0.03, 9 + k)]},
            text='Seed 1 < 2.',
            nis={'imu/mag': trace},
            timing={'p99 per message [µs]': 31.25},
        )
        for k in range(2)
    ]


@pytest.fixture(scope='module')
def page(runs, tmp_path_factory):
    folder = tmp_path_factory.mktemp('report')
    return write_report(folder / 'out' / 'report.html', runs, 'Attitude', 'All & sundry', pngs=folder / 'png')


def test_page_is_well_formed_and_needs_nothing_from_elsewhere(page):
    parsed = parse(page)
    text = page.read_text(encoding='utf-8')
    assert all(r.startswith('#') for r in parsed.references)
    assert 'http' not in text
    assert '@import' not in text
    assert not re.search(r'url\((?!#)', text)
    assert not {'script', 'link', 'iframe', 'img', 'object'} & set(parsed.tags)


def test_page_holds_every_panel_table_and_figure_of_merit(page, runs):
    parsed = parse(page)
    assert parsed.tags.count('svg') == 2 * (3 * 2 + 1)  # value and error of three angles, one NIS
    words = ' '.join(parsed.text)
    for run in runs:
        assert run.name in words
        for comparisons in run.comparisons.values():
            rmse = comparisons[0].score.component('total').rmse
            assert f'{rmse:.3g}' in words
    assert 'mean' in words
    assert '31.2' in words


def test_colours_follow_the_theme(page):
    text = page.read_text(encoding='utf-8')
    assert 'prefers-color-scheme:dark' in text
    assert all(f'--{k}:{v}' in text for palette in (LIGHT, DARK) for k, v in palette.items())
    drawings = ''.join(re.findall(r'<svg.*?</svg>', text, flags=re.DOTALL))
    assert 'var(--s0)' in drawings
    assert not re.search(r'#0000[0-9a-f]{2}\b', drawings)


@pytest.mark.parametrize('palette', [LIGHT, DARK])
def test_text_and_lines_stand_out_from_the_panel(palette):
    def luminance(code):
        c = np.array([int(code[i : i + 2], 16) for i in (1, 3, 5)]) / 255.0
        c = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
        return float(c @ [0.2126, 0.7152, 0.0722])

    def contrast(a, b):
        high, low = sorted((luminance(a), luminance(b)), reverse=True)
        return (high + 0.05) / (low + 0.05)

    # WCAG 2.1: 4.5 for text, which lines are named by; 3 for other graphics.
    for name in ('ink', 'muted', *(f's{i}' for i in range(6))):
        assert contrast(palette[name], palette['panel']) >= 4.5, name
    assert contrast(palette['truth'], palette['panel']) >= 3.0


def test_pngs_are_pictures_in_the_light_palette(page):
    from PIL import Image

    files = sorted((page.parent.parent / 'png').glob('*.png'))
    names = [f'run_{k}_co_{what}' for k in range(2) for what in ('nis', 'orientation')]
    assert [f.stem for f in files] == names
    picture = Image.open(files[1]).convert('RGB')
    assert picture.width > 1000
    assert picture.getpixel((0, 0)) == (255, 255, 255)
    blue = tuple(int(LIGHT['s0'][i : i + 2], 16) for i in (1, 3, 5))
    pixels = np.asarray(picture).reshape(-1, 3).astype(int)
    assert np.abs(pixels - blue).max(axis=1).min() < 12


@given(
    st.lists(st.floats(0, 1), min_size=1, max_size=6),
)
@settings(max_examples=50, deadline=None)
def test_labels_never_overlap(targets):
    placed = np.sort(spread(np.array(targets), 0.12, 0.0, 1.0))
    assert np.all(np.diff(placed) >= 0.12 - 1e-12)
    assert placed[-1] <= 1.0


def test_thinning_keeps_the_worst_spike():
    x = np.arange(100_000.0)
    y = np.zeros(100_000)
    y[54_321] = 7.0
    tx, ty = thin(x, y)
    assert len(tx) < 1000
    assert tx[np.argmax(ty)] == 54_321


def test_no_line_is_drawn_across_a_gap():
    x = np.concatenate((np.arange(10.0), np.arange(100.0, 110.0)))
    bx, by = broken(x, np.ones(20))
    assert np.isnan(by).sum() == 1
    assert bx[np.isnan(by)] == pytest.approx(9.0)


def test_nothing_to_report_is_an_error_and_leaves_no_page(tmp_path):
    with pytest.raises(BagError, match='nothing to report'):
        write_report(tmp_path / 'r.html', [], 'Empty')
    assert not (tmp_path / 'r.html').exists()


def test_command_line_reports_bags(tmp_path, capsys):
    write_sensors(tmp_path / 'in', seconds=3.0)
    result = offline(MIX, {}, tmp_path / 'in', tmp_path / 'est.mcap', copy=['*'])
    assert nis_of(result)['imu/data_raw'].nis == pytest.approx([3.0, 3.0])
    out = tmp_path / 'r.html'
    call = [str(tmp_path / 'est.mcap'), '--estimate', 'mixture', '--truth', '/mixture', '-o', str(out)]
    assert tool.main(call) == 0
    assert str(out) in capsys.readouterr().out
    assert parse(out).tags.count('svg') == 6
    assert tool.main([*call[:-4], '--truth', '/absent', '-o', str(out)]) == 2
    assert "no topic '/absent'" in capsys.readouterr().err


def test_nis_lies_on_the_time_axis_of_the_bag_and_says_whose_it_is(tmp_path):
    with BagWriter(tmp_path / 'in') as bag:
        bag.add('imu/data_raw', IMU)
        bag.add('imu/mag', MAG)
        for k in range(100):
            stamp = SECOND + k * SECOND // 10
            bag.write('/imu/mag', stamp, mag(stamp, (1.0, 2.0, 3.0)))
            if k > 40:
                bag.write('/imu/data_raw', stamp, imu(stamp, (1.0, 2.0, 3.0)))
    result = offline(MIX, {}, tmp_path / 'in', tmp_path / 'out')
    traces = nis_of(result, 'mix')
    assert list(traces) == ['mix: imu/data_raw']
    assert traces['mix: imu/data_raw'].seconds == pytest.approx(np.arange(5.0, 10.0))
    errors = comparison(0.01, 1)
    (panel,) = panels_of_nis(RunResult('run', {'mix': [errors]}, nis=traces))
    assert panel.title == 'mix: imu/data_raw'
    assert panel.span == (0.0, pytest.approx(errors.times[-1]))
    low, high = draw([panel]).axes[0].get_xlim()
    assert low < 0.0
    assert high > errors.times[-1]


@pytest.mark.parametrize(
    ('names', 'short'),
    [
        (['imu/data', 'truth'], ['imu/data', 'truth']),
        (
            ['robot/front/attitude/imu/data', 'robot/rear/attitude/imu/data', 'truth'],
            ['…/front/…', '…/rear/…', 'truth'],
        ),
        (['robot/localisation/filtered/a', 'robot/localisation/filtered/b'], ['…/a', '…/b']),
        (['a_very_long_name_without_any_folders'], ['a_very_long…_any_folders']),
        (['robot/front/attitude/imu/data', 'truth'], ['robot/front…ude/imu/data', 'truth']),
        (['same/topic/of/a/long/name', 'same/topic/of/a/long/name'], ['same/topic/…/a/long/name'] * 2),
    ],
)
def test_long_names_keep_what_tells_them_apart(names, short):
    assert short_names(names) == short


@given(st.lists(st.text('ab/_', min_size=1, max_size=60), min_size=1, max_size=5))
@settings(max_examples=200, deadline=None)
def test_short_names_are_short(names):
    assert all(0 < len(name) <= 24 for name in short_names(names))


def test_every_name_and_title_lies_within_its_panel():
    x = np.arange(10.0)
    names = ['robot/front/attitude/imu/data', 'robot/front_left_wheel_housing/attitude/imu/data', 'M' * 60]
    panel = Panel('attitude_estimator: ' + 'robot/sensor/' * 4, 'm', [Line(n, x, x, 's0') for n in names])
    figure = draw([panel])
    renderer = FigureCanvasAgg(figure).get_renderer()
    (ax,) = figure.axes
    for text in (ax.title, ax._left_title, *ax.texts):
        if 'M' not in text.get_text():
            assert text.get_window_extent(renderer).x1 <= figure.bbox.x1


def test_diagnostics_of_a_recording_give_nis_and_timing(tmp_path):
    with BagWriter(tmp_path / 'bag') as bag:
        bag.add('/diagnostics', 'diagnostic_msgs/msg/DiagnosticArray')
        for k in range(3):
            array = zeroed('diagnostic_msgs/msg/DiagnosticArray')
            for name, values in (
                ('f', {'processing_p99_s': '3.1e-05'}),
                ('f: imu', {'nis': f'{k}', 'gate': '9'}),
            ):
                status = zeroed('diagnostic_msgs/msg/DiagnosticStatus')
                status.name = name
                for key, value in values.items():
                    pair = zeroed('diagnostic_msgs/msg/KeyValue')
                    pair.key, pair.value = key, value
                    status.values.append(pair)
                array.status.append(status)
            bag.write('/diagnostics', SECOND * (k + 1), array)
    nis, timing = diagnostics_of(tmp_path / 'bag')
    assert nis['f: imu'].nis.tolist() == [0.0, 1.0, 2.0]
    assert nis['f: imu'].seconds == pytest.approx([0.0, 1.0, 2.0])
    assert timing == {'f, p99 per message [µs]': pytest.approx(31.0)}


def shown_in_chromium(page, script, tmp_path):
    """Return the title that `script` gives to a page on a screen as narrow as a phone's."""
    chromium = shutil.which('chromium')
    if chromium is None:
        assert 'WS_REQUIRE_PROGRAMS' not in os.environ, 'chromium is not installed'
        pytest.skip('chromium is not installed')
    probe = tmp_path / 'probe.html'
    script = f'<script>{script}</script></body>'
    probe.write_text(page.read_text(encoding='utf-8').replace('</body>', script), encoding='utf-8')
    base = [
        chromium,
        '--headless',
        '--no-sandbox',
        '--disable-gpu',
        f'--user-data-dir={tmp_path / "profile"}',
    ]
    dom = subprocess.run(
        [*base, '--window-size=500,900', '--dump-dom', probe.as_uri()],
        capture_output=True, text=True, timeout=120, check=True,
    ).stdout  # fmt: skip
    shown = re.search(r'<title>(\d+)/(\d+)</title>', dom)
    assert shown, dom[:500]
    return int(shown[1]), int(shown[2])


def test_chromium_shows_the_page_without_overflow(page, tmp_path):
    script = 'document.title=document.documentElement.scrollWidth+"/"+innerWidth'
    wide, screen = shown_in_chromium(page, script, tmp_path)
    assert wide <= screen


def test_no_column_of_a_table_is_off_a_narrow_screen(runs, tmp_path):
    head = table(
        ('system', 'figure', 'paper', 'best peer', 'here', 'bar <b>&amp; "more"</b>'),
        [
            (
                'INS/GPS',
                'mean error after 60 s',
                '6.57 m',
                'memoryless fix 1.614 m',
                '<b>0.1018 m</b>',
                '≤ 0.12 m',
            )
        ],
    )
    assert 'data-head="bar &amp; &quot;more&quot;"' in head
    page = write_chapters(tmp_path / 'r.html', [Chapter('A', runs)], 'Five', head)
    script = (
        'document.querySelectorAll("details").forEach(d=>d.open=true);'
        'document.title=Math.round(Math.max(...[...document.querySelectorAll("td,figure")].map('
        'e=>e.getBoundingClientRect().right)))+"/"+innerWidth'
    )
    right, screen = shown_in_chromium(page, script, tmp_path)
    assert 300 < right <= screen <= 500


@pytest.mark.parametrize(
    ('bags', 'names'),
    [
        (['a/estimates.mcap', 'b/estimates.mcap'], ['a/estimates', 'b/estimates']),
        (['out/noise_0.5', 'out/noise_0.7'], ['noise_0.5', 'noise_0.7']),
        (['one.mcap'], ['one']),
        (['one.mcap', 'one.mcap'], None),
    ],
)
def test_each_bag_of_a_report_has_a_name_of_its_own(bags, names):
    found = bag_names(bags)
    assert len(set(found)) == len(bags)
    assert names is None or found == names
