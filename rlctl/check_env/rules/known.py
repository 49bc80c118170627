"""What families that are not converted yet import. Goes when the last one is."""

from rlctl.check_env.legacy import built as built
from rlctl.check_env.legacy import known_result as result
from rlctl.check_env.legacy import lived as lived
from rlctl.check_env.legacy import one as one
from rlctl.check_env.legacy import why_missing as why_missing
from rlctl.check_env.no_display import NO_DISPLAY as NO_DISPLAY
from rlctl.check_env.no_display import lost_display as lost_display

__all__ = ["NO_DISPLAY", "built", "lived", "lost_display", "one", "result", "why_missing"]
