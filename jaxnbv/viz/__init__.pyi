from .answers import Words as Words
from .answers import words_of as words_of
from .data import ReportData as ReportData
from .data import report_data as report_data
from .figures import write_figures as write_figures
from .live import LiveView as LiveView
from .notebook import show as show
from .report import write_report as write_report
