"""How a result is told: a page to hand on, and a few lines in the terminal."""

from bayesoleo.report.page import render_report, write_report
from bayesoleo.report.plain import write_plain_report
from bayesoleo.report.sentences import headline
from bayesoleo.report.terminal import print_summary

__all__ = ["headline", "print_summary", "render_report", "write_plain_report", "write_report"]
