"""Campaigns: the jobs of a campaign file, their results, and comparisons."""

from sidestep.store.campaign import Store
from sidestep.trials.campaign.comparison import Comparison, Group, Pair, compare
from sidestep.trials.campaign.jobs import Job, Task, run_task
from sidestep.trials.campaign.plan import Campaign, CampaignError, CompareSettings, load_campaign
from sidestep.trials.campaign.rows import campaign_rows

__all__ = [
    "Campaign",
    "CampaignError",
    "CompareSettings",
    "Comparison",
    "Group",
    "Job",
    "Pair",
    "Store",
    "Task",
    "campaign_rows",
    "compare",
    "load_campaign",
    "run_task",
]
