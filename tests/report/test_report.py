"""The report is one offline page that says what the numbers say."""

import json
import re
from dataclasses import replace

import matplotlib
import pytest
from html_page import HOSTILE, Page, check_hostile_names

from neeco.evaluation.evaluate import evaluate_run
from neeco.report.page import Series, line_chart
from neeco.report.run_page import chosen_rows, curve, read_metrics, write_report

VOID = {"meta", "img", "br", "link"}


@pytest.fixture(scope="module")
def reported(world, tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    found = {"hinge_axis": [0.0, 1.0, 0.0], "verdict": "joint <found>"}
    scene = world.TinyScene(diagnostics={"bar": found, "shadow": [{"found_at_mm": [], "iteration": 600}]})
    capture = world.make_capture(folder / "capture", world.TinyScene(), ("train", "test", "test", "unseen"))
    rows = [
        {"iteration": i * 10, "loss": 1 / (i + 1), "psnr": 20 + i / 9, "num_gaussians": 100 + i, "phase": 1 + (i > 20),
         "seconds": i * 0.5}
        for i in range(50)
    ]  # fmt: skip
    (folder / "metrics.jsonl").write_text("\n".join(map(json.dumps, rows)) + '\n{"iteration": 5')
    (folder / "config.yaml").write_text("method: tiny\nnote: <b>\n")
    evaluation = evaluate_run(world.TinyRun(folder, scene, capture), capture, align=True)
    path = write_report(folder, evaluation, capture, scene)
    return folder, capture, scene, evaluation, path


def test_the_page_is_whole_and_fetches_nothing(reported):
    text = reported[-1].read_text()
    page = Page(VOID)
    page.feed(text)
    assert page.open == []
    assert all(reference.startswith("data:image/") for reference in page.references)
    assert len(page.references) == 3 * 4  # two test frames and one unseen, four pictures each
    assert "http" not in text.replace("http-equiv", "")
    assert page.tags.count("svg") == 3
    assert "prefers-color-scheme: dark" in text
    assert "@media print" in text
    assert "viewport" in page.tags or 'name="viewport"' in text


def test_the_page_says_the_numbers_and_the_notes(reported):
    *_, evaluation, path = reported
    text = path.read_text()
    for kind in ("given", "aligned"):
        assert f"<td>{evaluation[kind]['test']['psnr']:.2f}</td>" in text
        assert f"<td>{evaluation[kind]['test']['mask_precision']:.3f}</td>" in text
        assert f"<td>{evaluation[kind]['test']['mask_recall']:.3f}</td>" in text
    assert all(piece in text for piece in ("phase 2", "0.4 min", "joint &lt;found&gt;", "note: &lt;b&gt;"))
    assert not re.search(r'<div class="scroll[^"]*">', text)  # tables that scroll are reached by the keyboard
    captions = {"recorded image", "rendered image", "difference of the two", "recorded image, label over it"}
    assert set(re.findall(r"<figcaption>(.*?)</figcaption>", text)) == captions


def test_a_tile_says_what_its_number_means(reported):
    tiles = re.findall(r'<div class="tile">.*?</div>', reported[-1].read_text(), re.DOTALL)
    assert len(tiles) >= 4
    for abbreviation, meaning in (("PSNR", "30 is good"), ("IoU", "1 is perfect"), ("Gaussians", "of the scene")):
        assert all(meaning in tile for tile in tiles if abbreviation in tile)
    assert not any("as given" in tile for tile in tiles)


def test_a_run_without_metrics_still_has_a_page(reported, tmp_path):
    _, capture, scene, evaluation, _ = reported
    text = write_report(tmp_path, evaluation, capture, scene).read_text()
    assert "<svg" not in text


def test_a_page_to_play_with_stands_in_a_frame_of_its_own_that_may_do_nothing_here(reported, tmp_path):
    _, capture, scene, evaluation, _ = reported
    text = write_report(tmp_path, evaluation, capture, scene, playable="<p title='a'>\"b\" & c</p>").read_text()
    assert 'sandbox="allow-scripts allow-downloads"' in text
    assert 'srcdoc="&lt;p title=&#39;a&#39;&gt;&#34;b&#34; &amp; c&lt;/p&gt;"' in text
    assert "<iframe" not in write_report(tmp_path, evaluation, capture, scene).read_text()


def test_best_median_and_worst_frame_are_shown_once_each():
    rows = [{"frame": name, "psnr": value} for name, value in zip("abcde", (3.0, 1.0, 5.0, None, 4.0), strict=True)]
    assert [(why, row["frame"]) for why, row in chosen_rows(rows)] == [("best", "c"), ("median", "a"), ("worst", "b")]
    assert [why for why, _ in chosen_rows(rows[:1])] == ["best"]
    assert chosen_rows([]) == []


def test_curves_mark_where_the_phase_changes_and_stay_out_when_there_is_nothing_to_draw(tmp_path):
    rows = [{"iteration": i, "loss": 1.0 - i / 20, "phase": 1 if i < 5 else 2} for i in range(10)]
    assert curve(rows, "loss", "loss").count('class="phase"') == 1
    assert "phase 2" in curve(rows, "loss", "loss")
    assert curve(rows, "psnr", "PSNR") == ""
    assert curve(rows[:1], "loss", "loss") == ""
    assert read_metrics(tmp_path / "none.jsonl") == []


def ticks_of(low, high):
    """What stands at the left of a chart of values from `low` to `high`."""
    svg = line_chart("", "x", [Series(0, ((0.0, low), (1.0, high)))])
    texts = re.findall(r"text-anchor: end[^>]*>([^<]+)</text>", svg)
    return [float(text) for text in texts]


def test_ticks_are_round_and_inside_the_range():
    assert ticks_of(0.0, 10.0) == [0, 5, 10]
    assert ticks_of(23.1, 29.7) == [24, 26, 28, 30]  # the chart ends at 30.03


def test_a_chart_has_no_fixed_colours_and_needs_nothing_from_elsewhere():
    rows = [{"iteration": i, "loss": 1.0 - i / 20, "phase": 1 if i < 5 else 2} for i in range(10)]
    svg = curve(rows, "loss", "loss $\\frac$ \u65e5 \x01")
    assert svg.startswith('<svg viewBox="0 0 420 190" role="img" aria-label="loss $')
    assert not re.search(r"http|url\(|: #[0-9a-f]{3}|<style", svg)
    assert "$\\frac$ \u65e5 \ufffd" in svg
    with matplotlib.rc_context({"font.size": 40.0}):  # the user's own settings change nothing
        assert curve(rows, "loss", "loss $\\frac$ \u65e5 \x01") == svg


def test_charts_of_one_page_have_ids_of_their_own_and_find_what_they_refer_to():
    charts = [line_chart(title, "x", [Series(0, ((0.0, 1.0), (1.0, 2.0)), dots=((0.5, 1.0),))]) for title in "ab"]
    defined = [re.findall(r' id="([^"]+)"', chart) for chart in charts]
    for names, chart in zip(defined, charts, strict=True):
        assert set(re.findall(r'href="#([^"]+)"', chart)) == set(names)
        assert len(set(names)) == len(names) > 0
    assert not set(defined[0]) & set(defined[1])


def test_hostile_names_are_text_and_the_same_data_gives_the_same_page(reported, world, tmp_path, noon):
    scene = world.TinyScene(method=HOSTILE, diagnostics={HOSTILE: {"hinge": HOSTILE, "verdict": HOSTILE}})
    capture = world.make_capture(tmp_path / HOSTILE, scene, ("train", "test"))
    (tmp_path / "config.yaml").write_text(HOSTILE)
    evaluation = evaluate_run(world.TinyRun(tmp_path, scene, capture), capture) | {"notes": [HOSTILE]}
    scene.instruments = (replace(scene.instruments[0], name=HOSTILE),)
    scene.label_names = ((HOSTILE, HOSTILE), ("bar", HOSTILE))
    check_hostile_names(lambda: write_report(tmp_path, evaluation, capture, scene).read_text(), VOID)
