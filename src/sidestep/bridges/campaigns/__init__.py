"""A campaign over the cores of this machine or of many, by Dask; one Parquet table (extra `cluster`)."""

from sidestep.bridges.campaigns.campaign import CampaignOutcome, Failure, run_campaign
from sidestep.bridges.campaigns.table import write_table

__all__ = ["CampaignOutcome", "Failure", "run_campaign", "write_table"]
