"""Pictures of an episode: an HTML report and PNG figures."""

from jaxnbv.viz.data import ReportData as ReportData
from jaxnbv.viz.data import report_data as report_data
from jaxnbv.viz.figures import write_figures as write_figures
from jaxnbv.viz.report import write_report as write_report
