"""The pages of a fleet in a real browser: they fit a phone, whatever names and builds are called."""

import numpy as np
import pytest

from browser_tab import Tab, launched
from fleet_history import columns, row, wrench
from rotorwatch.fleet import Entry, Store, assess, fleet_pages

NAME = "CubeOrangePlusWithALongNameOfAnAircraft-3334"


@pytest.mark.thorough(keep=1)
@pytest.mark.parametrize("looks", [{"is_mobile": True, "has_touch": True}, {}], ids=["phone", "narrow"])
def test_pages_of_a_fleet_fit_a_phone(tmp_path, chromium, looks):
    with Store(tmp_path / "fleet.db") as store:
        for k in range(12):
            loss = np.array([[0.0, 0.0, 0.2 if k > 6 else 0.0, 0.0]])
            reported = row(k, wrench(columns(4), loss)[0], 4)
            known = {name: reported[name] for name in ("utc", "airborne_s", "rotors", "trim")}
            verdict = "crashed" if k > 9 else "healthy"
            name = f"{k}_field_test_with_a_very_long_name_and_more_of_it_2026-05-01.bin"
            store.add(
                Entry(
                    f"{k:064x}", name, name, 1, f"serial BOARD_{'7BD7DF1A31049CD7' * 4}", NAME, verdict=verdict, build=f"build_{'x' * 80}",
                    **known,
                )
            )  # fmt: skip
        store.service(NAME, 2, "new_propeller_with_a_long_description_that_has_no_spaces_in_it", after=5)
        assess.refresh(store)
        made = fleet_pages.write(store, tmp_path / "pages")
    with launched(chromium) as browser:
        for path in made:
            tab = Tab(browser, path.as_uri(), viewport={"width": 390, "height": 844}, **looks)
            assert tab.page.evaluate("innerWidth") == 390 and tab.overflow() <= 0, path.name
            assert tab.violations() == [] and tab.wrong == []
            assert "crashed" in tab.page.locator("body").inner_text()
