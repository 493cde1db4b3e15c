from .answers import Words as Words
from .answers import words_of as words_of
from .data import ReportData as ReportData
from .data import report_data as report_data
from .live import LiveView as LiveView
from .notebook import show as show
from .report import write_report as write_report
from .sketches import Sketches as Sketches
