"""The labelling room: DAgger rounds that a person answers, from Python, from a script, or on a page in a browser (`rtg label`)."""

from .queue import Answer as Answer
from .queue import LabelQueue as LabelQueue
from .queue import answer_by as answer_by
from .run import LabelledRun as LabelledRun
from .run import Round as Round
from .run import open_labelling as open_labelling
from .run import start_labelling as start_labelling
