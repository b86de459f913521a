"""The paper's runs as a study: its file, and what it says of the paper's conclusions. Results do not depend on it."""

from engine.study.conclusions import Conclusion, conclusions_markdown, study_conclusions, verdict
from engine.study.file import STUDY_FORMAT, STUDY_METADATA_KEY, Study, read_study

__all__ = [
    "STUDY_FORMAT",
    "STUDY_METADATA_KEY",
    "Conclusion",
    "Study",
    "conclusions_markdown",
    "read_study",
    "study_conclusions",
    "verdict",
]
