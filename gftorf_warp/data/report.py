"""Result of ``gftorf check``: facts and named findings."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

NAMES = {"capture": "capture", "ftorf": "F-ToeRF", "torf": "ToeRF"}


@dataclass(frozen=True, kw_only=True)
class Finding:
    """Something that is probably wrong, or was assumed."""

    name: str
    """Name of the rule; docs/check.md has a row for each."""
    text: str
    """What was found, why it is implausible, and what would mend it."""


@dataclass(kw_only=True)
class Report:
    """Result of a check; ``str`` of it is printed."""

    path: Path | None
    """The sequence; None if it exists in memory only."""
    form: str
    """Its format, ``capture``, ``ftorf`` or ``torf``."""
    lines: list[str] = field(default_factory=list)
    """Facts, one a line."""
    findings: list[Finding] = field(default_factory=list)
    """Implausible or assumed values."""

    def __str__(self) -> str:
        head = f"{self.path or 'in memory'}: {NAMES[self.form]} sequence"
        flags = [f"warning: {one.text} [{one.name}]" for one in self.findings] or ["no warnings"]
        return "\n".join([head, *(f"  {line}" for line in self.lines), *flags])

    @property
    def warnings(self) -> list[str]:
        """Texts of the findings."""
        return [one.text for one in self.findings]

    def add(self, name: str, text: str) -> None:
        """Add a fact under its name."""
        self.lines.append(f"{name:<15} {text}")

    def warn(self, name: str, text: str) -> None:
        """Add a finding under the name of its rule."""
        self.findings.append(Finding(name=name, text=text))
