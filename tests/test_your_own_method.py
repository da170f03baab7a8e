"""docs/your-own-method.md: its Python blocks run as they stand, one after the other, and what they show is so."""

import re
from pathlib import Path

import numpy as np

PAGE = Path(__file__).resolve().parents[1] / "docs" / "your-own-method.md"


def test_the_pages_blocks_run_one_after_the_other(capsys):
    names = {}
    for k, block in enumerate(re.findall(r"^```python\n(.*?)^```", PAGE.read_text(), re.DOTALL | re.MULTILINE)):
        exec(compile(block, f"{PAGE.name}, block {k + 1}", "exec"), names)
    said = capsys.readouterr().out
    assert "(1500, 4) (1500, 4)" in said
    losses = names["out"].theta[-1]
    np.testing.assert_allclose(losses, [0.0, 0.25, 0.0, 0.0], atol=0.05)
    table = dict((row[0], row[1:]) for row in names["rows"])
    assert set(table) == {"slow_observer", "ekf", "adaptive_ekf", "ukf"}
    for name, (rmse, delay) in table.items():
        assert rmse < 0.1 and delay < 5.0, name
    # The estimator of the page runs on the page's other plant, too.
    plant, method = names["climber"], names["SlowObserver"]
    rw = names["rw"]
    made = rw.simulate_system(plant, np.full((200, 4), 1.4 * 9.80665 / 32.0), 0.0, 0.02)
    assert np.isfinite(rw.run(method(plant, 0.02), made.u, made.y, dt=made.dt)[1].theta).all()


def test_the_pages_method_can_enter_the_benchmark(tmp_path, monkeypatch):
    from rotorwatch_lab.campaign import benchmark

    blocks = re.findall(r"^```python\n(.*?)^```", PAGE.read_text(), re.DOTALL | re.MULTILINE)
    (own,) = [block for block in blocks if "class SlowObserver" in block]
    (tmp_path / "my_file.py").write_text(own)
    monkeypatch.syspath_prepend(str(tmp_path))
    (method,) = benchmark.selected_methods(["my_file:SlowObserver"])
    assert method.name == "slow_observer" and benchmark.try_out(method) is None
