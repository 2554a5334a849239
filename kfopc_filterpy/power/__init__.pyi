from .budget import PowerBudget as PowerBudget
