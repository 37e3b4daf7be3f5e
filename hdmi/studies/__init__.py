"""Studies: variants of a training over tasks and seeds, evaluated, with statistics, figures and a report."""

from hdmi.studies.document import write_report
from hdmi.studies.plan import Figure, Job, Study, Variant, read_study, study_files
from hdmi.studies.run import run_study

__all__ = ["Figure", "Job", "Study", "Variant", "read_study", "run_study", "study_files", "write_report"]
