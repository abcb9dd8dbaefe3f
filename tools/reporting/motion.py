"""What the arm did: how closely it followed, and whether anything was touched or cut."""

from __future__ import annotations

from typing import Any

import numpy as np

from rack.backplane.layout import Layout
from rack.tools.recording import Recording

SERVO_STATUS = "servo_status"
"""Message type of the level that drives the arm."""


def motion(recording: Recording, layout: Layout) -> dict[str, Any] | None:
    """Return tracking error, mrad, and the counts of touches, broken limits and cut set points; None without an arm."""
    mailbox = next((m.name for m in layout.mailboxes if m.message == SERVO_STATUS), None)
    if mailbox is None or mailbox not in recording.mailboxes:
        return None
    error = (recording.signal(mailbox, "position") - recording.signal(mailbox, "target")) * 1e3
    return {
        "tracking_rms_mrad": round(float(np.sqrt(np.mean(error**2))), 6),
        "tracking_peak_mrad": round(float(np.abs(error).max()), 6),
        **{name: int(recording.signal(mailbox, name)[-1]) for name in ("touches", "violations", "pushed")},
        "clipped_cycles": int(recording.signal(mailbox, "clipped")[-1]),
    }
