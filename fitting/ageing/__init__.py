"""An ageing drive: wear coefficient and bearing wear from dated figures, and a forecast of them with its interval."""
