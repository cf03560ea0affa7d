"""Ticks of a real drive, as the oracle and as peers are told them."""

from oracle.tick import Tick


def oracle_tick(program, estimate, past):
    """The oracle's tick for a controller's `program` and `estimate`, with `past` (memory, 2) on its way; a copy."""
    return Tick(
        pose=estimate.pose.copy(),
        state=estimate.state.copy(),
        slip=estimate.slip,
        past=past.copy(),
        last_command=program.last_command.copy(),
        aim=program.aim[:, :3].copy(),
        heading=program.aim[:, 3].copy(),
        feed_forward=program.feed_forward.copy(),
        fed_before=program.fed_before.copy(),
        late=program.late.copy(),
    )
