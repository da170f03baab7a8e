"""Campaigns: thousands of simulated flights, drawn from a plan, assessed by any estimator or detector, with their statistics.

    from rotorwatch import campaign
    plan = campaign.read("plans/default.toml")
    table = campaign.run(plan, 1000, "results")        # again: goes on where it was stopped
    campaign.summarise(table)

See docs/campaigns.md.
"""

from rotorwatch_lab.campaign.plan import Plan, from_table, read
from rotorwatch_lab.campaign.summary import markdown, summarise
from rotorwatch_lab.campaign.work import run

__all__ = ["Plan", "from_table", "markdown", "read", "run", "summarise"]
