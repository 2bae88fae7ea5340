# mvrecon with all plugins, for a CPU: docker build -t mvrecon . && docker run mvrecon mvrecon-list
# All checks: docker run mvrecon bash scripts/test.sh
FROM python:3.11-slim
RUN apt-get update && apt-get install --yes --no-install-recommends g++ && rm -rf /var/lib/apt/lists/*
WORKDIR /mvrecon
COPY . .
ENV PIP_EXTRA_INDEX_URL=https://download.pytorch.org/whl/cpu PATH=/mvrecon/.venv/bin:$PATH
RUN bash scripts/setup.sh dev && mvrecon-warmup
CMD ["mvrecon-list"]
