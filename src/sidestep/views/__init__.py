"""Figures, animations, the report and the live page."""

from sidestep.views.animation import animate
from sidestep.views.capture_figure import capture_figure
from sidestep.views.certificate_figure import certificate_figure
from sidestep.views.clearance_figure import clearance_figure
from sidestep.views.comparison import Section, comparison_sections, markdown_tables
from sidestep.views.episode_report import write_episode_report
from sidestep.views.intervention_figure import intervention_figure
from sidestep.views.obstacle_figure import obstacle_figure
from sidestep.views.report import write_report
from sidestep.views.runs import CAPTURE_FILE, EVALUATION_FILE, SCENE_FILE, Run, load_run
from sidestep.views.time_figure import time_figure
from sidestep.views.training_figures import outcome_figure, reward_figure, safety_rows, safety_table
from sidestep.views.trajectory_figures import scenes_figure, trajectory_figure
from sidestep.views.twin_figure import twin_figure
from sidestep.views.video_files import VideoError

__all__ = [
    "CAPTURE_FILE",
    "EVALUATION_FILE",
    "SCENE_FILE",
    "Run",
    "Section",
    "VideoError",
    "animate",
    "capture_figure",
    "certificate_figure",
    "clearance_figure",
    "comparison_sections",
    "intervention_figure",
    "load_run",
    "markdown_tables",
    "obstacle_figure",
    "outcome_figure",
    "reward_figure",
    "safety_rows",
    "safety_table",
    "scenes_figure",
    "time_figure",
    "trajectory_figure",
    "twin_figure",
    "write_episode_report",
    "write_report",
]
