"""report.html: the course and the result of a training run."""

from snowsplat.training.report.report_page import Trained, write_training_report

__all__ = ["Trained", "write_training_report"]
