"""Campaigns on one machine or on a cluster, with Dask; results as a Parquet table (extra `cluster`)."""

from sidestep.bridges.campaigns.campaign import CampaignOutcome, Failure, run_campaign
from sidestep.bridges.campaigns.table import write_table

__all__ = ["CampaignOutcome", "Failure", "run_campaign", "write_table"]
