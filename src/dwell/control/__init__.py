"""The Controller: windows, estimator, policy and order, the same in both engines."""

import lazy_loader

from dwell.control.plain_rule import plain_rule as plain_rule  # its module has the same name

# Types for packages that import neither estimators nor policies.
from dwell.estimators import Estimator as Estimator
from dwell.estimators import Evidence as Evidence
from dwell.estimators import Instants as Instants
from dwell.estimators.evidence import NOT_DUE as NOT_DUE
from dwell.policies import MinimalPolicy as MinimalPolicy

# The names are in the stub; each is imported at its first use.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
