variable "bucket" {
  description = "Name of the bucket."
  type        = string
  validation {
    condition     = can(regex("^[a-z0-9][a-z0-9-]{1,61}[a-z0-9]$", var.bucket))
    error_message = "Give 3 to 63 lower-case letters, digits and hyphens."
  }
}

variable "prefix" {
  description = "Prefix of one cluster's objects in the bucket."
  type        = string
  validation {
    condition     = can(regex("^[A-Za-z0-9_-][A-Za-z0-9._-]*(/[A-Za-z0-9_-][A-Za-z0-9._-]*)*$", var.prefix))
    error_message = "Give a path of letters, digits and ._- without a slash at either end, as plat's --store takes it."
  }
}

variable "oidc_provider_arn" {
  description = "IAM's name of the OpenID Connect provider."
  type        = string
  validation {
    condition     = can(regex("^arn:aws[a-z-]*:iam::[0-9]{12}:oidc-provider/.+$", var.oidc_provider_arn))
    error_message = "Give it as arn:aws:iam::123456789012:oidc-provider/..."
  }
}

variable "namespace" {
  description = "Kubernetes namespace of the service accounts."
  type        = string
}
