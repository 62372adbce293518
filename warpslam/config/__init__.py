"""Settings: groups with units, ranges and reasons; presets; yaml in and out."""

from warpslam.config.presets import PRESETS as PRESETS
from warpslam.config.settings import Config as Config
from warpslam.config.settings import DirectConfig as DirectConfig
from warpslam.config.settings import GridConfig as GridConfig
from warpslam.config.settings import ImapConfig as ImapConfig
from warpslam.config.settings import KeyframeConfig as KeyframeConfig
from warpslam.config.settings import LoopConfig as LoopConfig
from warpslam.config.settings import MappingConfig as MappingConfig
from warpslam.config.settings import MeshingConfig as MeshingConfig
from warpslam.config.settings import SamplingConfig as SamplingConfig
from warpslam.config.settings import SupervisionConfig as SupervisionConfig
from warpslam.config.settings import TrackingConfig as TrackingConfig
from warpslam.config.settings import TsdfConfig as TsdfConfig
