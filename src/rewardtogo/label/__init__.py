"""The room of people: DAgger rounds that a person answers (`rtg label`), and demonstrations that a person plays (`rtg demonstrate`).

Each from Python, from a script, or on a page in a browser.
"""

from .playing import Playing as Playing
from .playing import play_by as play_by
from .playing import start_playing as start_playing
from .queue import Answer as Answer
from .queue import LabelQueue as LabelQueue
from .queue import answer_by as answer_by
from .run import LabelledRun as LabelledRun
from .run import Round as Round
from .run import open_labelling as open_labelling
from .run import start_labelling as start_labelling
