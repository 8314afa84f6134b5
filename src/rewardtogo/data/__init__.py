"""Data at rest: replay, trajectories, datasets of whole episodes, and the files they live in."""

from .episodes import Dataset as Dataset
from .episodes import concatenate as concatenate
from .episodes import load_dataset as load_dataset
from .episodes import save_dataset as save_dataset
from .files import Damaged as Damaged
from .growing import GrowingDataset as GrowingDataset
from .minari import from_minari as from_minari
from .minari import to_minari as to_minari
from .n_step import n_step as n_step
from .n_step import n_step_windows as n_step_windows
from .noise import perturb as perturb
from .prioritised import PrioritisedReplay as PrioritisedReplay
from .replay import Replay as Replay
from .replay import ReplayState as ReplayState
from .replay import UniformReplay as UniformReplay
from .trajectories import Trajectory as Trajectory
from .trajectories import join_episodes as join_episodes
from .trajectories import split_episodes as split_episodes
