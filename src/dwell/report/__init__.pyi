from .comparison_page import comparison_html as comparison_html
from .comparison_page import comparison_text as comparison_text
from .run_page import run_html as run_html
from .study_page import study_html as study_html
from .trace_events import trace_events as trace_events
