"""What families that are not converted yet import. Goes when the last one is."""

from rlctl.check_env.legacy import Evidence as Evidence
from rlctl.check_env.messages import (
    ENDS as ENDS,
)
from rlctl.check_env.messages import (
    FIRST_SEED as FIRST_SEED,
)
from rlctl.check_env.messages import (
    GYMNASIUM as GYMNASIUM,
)
from rlctl.check_env.messages import (
    MOST_INFOS as MOST_INFOS,
)
from rlctl.check_env.messages import (
    RAISED as RAISED,
)
from rlctl.check_env.messages import (
    SB3 as SB3,
)
from rlctl.check_env.messages import (
    SECOND_SEED as SECOND_SEED,
)
from rlctl.check_env.messages import (
    Built as Built,
)
from rlctl.check_env.messages import (
    Complaint as Complaint,
)
from rlctl.check_env.messages import (
    Failure as Failure,
)
from rlctl.check_env.messages import (
    Form as Form,
)
from rlctl.check_env.messages import (
    Series as Series,
)
from rlctl.check_env.messages import (
    Trajectory as Trajectory,
)
