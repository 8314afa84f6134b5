"""Chapter 2: imitation learning."""

from .bc import BC as BC
