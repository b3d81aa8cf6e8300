# Types for packages that import neither estimators nor policies.
import dwell.estimators
import dwell.policies

from .controller import ClosedWindow as ClosedWindow
from .controller import Controller as Controller
from .controller import LookedAt as LookedAt
from .controller import Proposal as Proposal
from .course import Course as Course
from .guard import CellGuard as CellGuard
from .guard import Failures as Failures
from .guard import FallbackRound as FallbackRound
from .guard import Guard as Guard
from .guard import Presence as Presence
from .guard import Probation as Probation
from .guard import parts_of as parts_of
from .plain_rule import plain_rule as plain_rule
from .windows import NO_AGE as NO_AGE
from .windows import age_l95_ms as age_l95_ms
from .windows import age_missed as age_missed
from .windows import final_l95_ms as final_l95_ms
from .windows import mean_age_ms as mean_age_ms
from .windows import moved_shares as moved_shares
from .windows import overtaken_cycles as overtaken_cycles
from .windows import reactions as reactions
from .windows import seen_costs as seen_costs

NOT_DUE: int
Estimator = dwell.estimators.Estimator
Evidence = dwell.estimators.Evidence
Instants = dwell.estimators.Instants
MinimalPolicy = dwell.policies.MinimalPolicy
