{{- define "looktwice.name" -}}
{{- if contains .Chart.Name .Release.Name }}{{ .Release.Name | trunc 50 | trimSuffix "-" }}
{{- else }}{{ printf "%s-%s" .Release.Name .Chart.Name | trunc 50 | trimSuffix "-" }}
{{- end }}
{{- end }}

{{- define "looktwice.selector" -}}
app.kubernetes.io/name: {{ .Chart.Name }}
app.kubernetes.io/instance: {{ .Release.Name }}
{{- end }}

{{- define "looktwice.labels" -}}
{{ include "looktwice.selector" . }}
app.kubernetes.io/version: {{ .Chart.AppVersion | quote }}
app.kubernetes.io/managed-by: {{ .Release.Service }}
helm.sh/chart: {{ printf "%s-%s" .Chart.Name .Chart.Version }}
{{- end }}

{{- /* Where one setting would make another one meaningless, nothing is rendered. */}}
{{- define "looktwice.check" -}}
{{- if le (int .Values.terminationGracePeriodSeconds) (int .Values.drainSeconds) }}
{{- fail "terminationGracePeriodSeconds must be longer than drainSeconds, or accepted requests are cut off" }}
{{- end }}
{{- if le (int .Values.drainSeconds) (int .Values.drainNoticeSeconds) }}
{{- fail "drainSeconds must be longer than drainNoticeSeconds, or no drain ends in time" }}
{{- end }}
{{- if and (eq .Values.engine.name "vllm") (ne .Values.engine.device "cuda") }}
{{- fail "engine.name vllm needs engine.device cuda" }}
{{- end }}
{{- if and .Values.engine.vllmArguments (ne .Values.engine.name "vllm") }}
{{- fail "engine.vllmArguments need engine.name vllm" }}
{{- end }}
{{- if not (or .Values.auth.open .Values.auth.existingSecret) }}
{{- fail "set auth.existingSecret, or auth.open=true where nobody needs a key" }}
{{- end }}
{{- if ne (empty .Values.checkpoint.existingClaim) (empty .Values.checkpoint.path) }}
{{- fail "checkpoint.existingClaim and checkpoint.path go together" }}
{{- end }}
{{- end }}
