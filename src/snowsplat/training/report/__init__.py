"""report.html: how a training went and what came of it."""

from snowsplat.training.report.page import Trained, write_training_report

__all__ = ["Trained", "write_training_report"]
