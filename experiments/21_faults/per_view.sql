select views, cells, printf('%.2f', max(case when depth = 'learned' then error end)) as [learned depths],
  printf('%.2f', max(case when depth = 'prior' then error end)) as [depths of the start volume]
from [experiments/21_faults/per_view.csv] group by views, cells order by views desc, cells desc
